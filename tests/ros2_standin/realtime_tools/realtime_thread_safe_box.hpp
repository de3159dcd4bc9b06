// Stand-in for tests, without a mutex.
#pragma once
#include <optional>
namespace realtime_tools
{
template <class T>
class RealtimeThreadSafeBox
{
public:
  void set(const T & value) { value_ = value; }
  bool try_set(const T & value) { value_ = value; return true; }
  [[nodiscard]] std::optional<T> try_get() const { return value_; }

private:
  T value_{};
};
}  // namespace realtime_tools
