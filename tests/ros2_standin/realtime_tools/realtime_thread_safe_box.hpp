// Stand-in for tests, without a mutex; ``held`` is what another thread that has it would make.
#pragma once
#include <optional>
namespace realtime_tools
{
inline bool held = false;

template <class T>
class RealtimeThreadSafeBox
{
public:
  void set(const T & value) { value_ = value; }
  bool try_set(const T & value) { if (!held) value_ = value; return !held; }
  [[nodiscard]] std::optional<T> try_get() const { return held ? std::nullopt : std::optional<T>(value_); }

private:
  T value_{};
};
}  // namespace realtime_tools
