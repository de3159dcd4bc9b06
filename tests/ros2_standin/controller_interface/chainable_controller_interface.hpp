// Stand-in for tests: the base class of ROS 2 Jazzy, as far as exported controllers use it.
#pragma once
#include <any>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "hardware_interface/handle.hpp"
#include "rclcpp/logging.hpp"
#include "rclcpp/qos.hpp"
#include "rclcpp/subscription.hpp"
#include "rclcpp/time.hpp"
#include "rclcpp_lifecycle/state.hpp"

namespace controller_interface
{
enum class return_type : std::uint8_t { OK = 0, ERROR = 1 };
enum class CallbackReturn : std::uint8_t { SUCCESS, FAILURE, ERROR };
enum class interface_configuration_type : std::uint8_t { ALL = 0, INDIVIDUAL = 1, NONE = 2 };

struct InterfaceConfiguration
{
  interface_configuration_type type = interface_configuration_type::NONE;
  std::vector<std::string> names = {};
};

class Parameter
{
public:
  explicit Parameter(std::any given) : value(std::move(given)) {}
  std::vector<std::string> as_string_array() const { return std::any_cast<std::vector<std::string>>(value); }
  std::vector<double> as_double_array() const { return std::any_cast<std::vector<double>>(value); }

private:
  std::any value;
};

class Node
{
public:
  const char * get_name() const { return name.c_str(); }
  rclcpp::Logger get_logger() const { return {}; }
  Parameter get_parameter(const std::string & key) const { return Parameter(parameters.at(key)); }
  template <typename MessageT, typename CallbackT>
  std::shared_ptr<rclcpp::Subscription<MessageT>> create_subscription(
    const std::string &, const rclcpp::QoS &, CallbackT && callback)
  {
    auto made = std::make_shared<rclcpp::Subscription<MessageT>>();
    made->callback = callback;
    subscription = made;
    return made;
  }
  std::string name = "loop";
  std::map<std::string, std::any> parameters;
  std::any subscription;  // the last one
};

class ChainableControllerInterface
{
public:
  virtual ~ChainableControllerInterface() = default;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_init() = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }

  std::shared_ptr<Node> get_node() const { return node; }
  unsigned int get_update_rate() const { return update_rate; }
  template <typename T>
  T auto_declare(const std::string & key, const T & default_value)
  {
    return std::any_cast<T>(node->parameters.try_emplace(key, default_value).first->second);
  }

  // What the controller manager does.
  void export_interfaces()
  {
    ordered_exported_reference_interfaces_ = on_export_reference_interfaces_list();
    ordered_exported_state_interfaces_ = on_export_state_interfaces_list();
  }
  void assign_interfaces(
    std::vector<hardware_interface::LoanedCommandInterface> && commands,
    std::vector<hardware_interface::LoanedStateInterface> && states)
  {
    command_interfaces_ = std::move(commands);
    state_interfaces_ = std::move(states);
  }
  return_type update(const rclcpp::Time & time, const rclcpp::Duration & period)
  {
    if (!chained && update_reference_from_subscribers(time, period) != return_type::OK) {
      return return_type::ERROR;
    }
    return update_and_write_commands(time, period);
  }
  const auto & references() const { return ordered_exported_reference_interfaces_; }
  const auto & states() const { return ordered_exported_state_interfaces_; }
  bool chained = false;
  unsigned int update_rate = 0;

protected:
  virtual std::vector<hardware_interface::StateInterface::SharedPtr> on_export_state_interfaces_list() { return {}; }
  virtual std::vector<hardware_interface::CommandInterface::SharedPtr> on_export_reference_interfaces_list() { return {}; }
  virtual return_type update_reference_from_subscribers(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  virtual return_type update_and_write_commands(const rclcpp::Time &, const rclcpp::Duration &) = 0;

  std::vector<hardware_interface::StateInterface::SharedPtr> ordered_exported_state_interfaces_;
  std::vector<hardware_interface::CommandInterface::SharedPtr> ordered_exported_reference_interfaces_;
  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;

private:
  std::shared_ptr<Node> node = std::make_shared<Node>();
};
}  // namespace controller_interface
