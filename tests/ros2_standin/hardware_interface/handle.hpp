// Stand-in for tests: interfaces with the member functions of ROS 2 Jazzy that exported controllers call.
#pragma once
#include <limits>
#include <memory>
#include <optional>
#include <string>

namespace hardware_interface
{
class Handle
{
public:
  explicit Handle(
    const std::string & prefix_name, const std::string & interface_name,
    const std::string & data_type = "double", const std::string & initial_value = "")
  : prefix(prefix_name), interface(interface_name), name(prefix_name + "/" + interface_name)
  {
    (void)data_type;
    (void)initial_value;
  }
  const std::string & get_name() const { return name; }
  const std::string & get_interface_name() const { return interface; }
  const std::string & get_prefix_name() const { return prefix; }
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional() const
  {
    return locked ? std::nullopt : std::optional<T>(value);
  }
  template <typename T>
  [[nodiscard]] bool set_value(const T & given)
  {
    if (!locked) {
      value = given > most ? most : given;
    }
    return !locked;
  }
  // For tests: another thread has the lock, and the joint limit.
  bool locked = false;
  double most = std::numeric_limits<double>::infinity();

private:
  std::string prefix, interface, name;
  double value = std::numeric_limits<double>::quiet_NaN();
};

class StateInterface : public Handle
{
public:
  using Handle::Handle;
  using SharedPtr = std::shared_ptr<StateInterface>;
  using ConstSharedPtr = std::shared_ptr<const StateInterface>;
};

class CommandInterface : public Handle
{
public:
  using Handle::Handle;
  using SharedPtr = std::shared_ptr<CommandInterface>;
};

class LoanedStateInterface
{
public:
  explicit LoanedStateInterface(StateInterface::ConstSharedPtr given) : handle(given) {}
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional(unsigned int = 10) const
  {
    return handle->get_optional<T>();
  }

private:
  StateInterface::ConstSharedPtr handle;
};

class LoanedCommandInterface
{
public:
  explicit LoanedCommandInterface(CommandInterface::SharedPtr given) : handle(given) {}
  const std::string & get_interface_name() const { return handle->get_interface_name(); }
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional(unsigned int = 10) const
  {
    return handle->get_optional<T>();
  }
  template <typename T>
  [[nodiscard]] bool set_value(const T & value, unsigned int = 10)
  {
    return handle->set_value(value);
  }

private:
  CommandInterface::SharedPtr handle;
};
}  // namespace hardware_interface
