// Chainable controller of ros2_control around the controller @name@ of quell, see README.md.
#include "@name@_controller.hpp"

#include <cmath>
#include <exception>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/logging.hpp"
#include "rclcpp/qos.hpp"

namespace @name@_ros2
{

using controller_interface::CallbackReturn;
using controller_interface::return_type;

namespace
{

constexpr double NOTHING = std::numeric_limits<double>::quiet_NaN();
constexpr unsigned int UPDATE_RATE = @rate@;  // [Hz] of the exported controller

// Names of the reference interfaces behind those of r, of each axis.
const std::vector<std::string> FURTHER = {@further_names@};

std::string joint_of(const std::string & name) { return name.substr(0, name.rfind('/')); }

std::string interface_of(const std::string & name) { return name.substr(name.rfind('/') + 1); }

}  // namespace

CallbackReturn @class@::on_init()
{
  try {
    auto_declare<std::vector<std::string>>("command_interfaces", {});
    auto_declare<std::vector<std::string>>("state_interfaces", {});
    auto_declare<std::vector<double>>("u_min", {});
    auto_declare<std::vector<double>>("u_max", {});
  } catch (const std::exception & error) {
    RCLCPP_ERROR(get_node()->get_logger(), "a parameter can't be declared: %s", error.what());
    return CallbackReturn::ERROR;
  }
  @name@_init(&state_);
  return CallbackReturn::SUCCESS;
}

bool @class@::read_names()
{
  command_names_ = get_node()->get_parameter("command_interfaces").as_string_array();
  state_names_ = get_node()->get_parameter("state_interfaces").as_string_array();
  if (command_names_.size() != ACTUATORS || state_names_.size() != AXES) {
    RCLCPP_ERROR(
      get_node()->get_logger(),
      "command_interfaces has %zu names and state_interfaces has %zu: must have %zu and %zu, "
      "as joint/effort and joint/position",
      command_names_.size(), state_names_.size(), ACTUATORS, AXES);
    return false;
  }
  for (const auto & names : {command_names_, state_names_}) {
    for (const auto & name : names) {
      const auto slash = name.rfind('/');
      if (slash == std::string::npos || slash == 0 || slash + 1 == name.size()) {
        RCLCPP_ERROR(
          get_node()->get_logger(), "interface '%s': must be a joint, / and an interface",
          name.c_str());
        return false;
      }
    }
  }
  return true;
}

bool @class@::read_limits()
{
  parameters_ = @name@_default_parameters;
  const auto low = get_node()->get_parameter("u_min").as_double_array();
  const auto high = get_node()->get_parameter("u_max").as_double_array();
  if ((!low.empty() && low.size() != ACTUATORS) || (!high.empty() && high.size() != ACTUATORS)) {
    RCLCPP_ERROR(
      get_node()->get_logger(),
      "u_min has %zu numbers and u_max has %zu: must be empty, for the exported limits, or have %zu",
      low.size(), high.size(), ACTUATORS);
    return false;
  }
  for (std::size_t k = 0; k < ACTUATORS; k++) {
    const double u_min = low.empty() ? @low@ : low[k];
    const double u_max = high.empty() ? @high@ : high[k];

    if (!(u_min < u_max)) {
      RCLCPP_ERROR(
        get_node()->get_logger(), "u_min = %g, u_max = %g: u_min must be below u_max", u_min,
        u_max);
      return false;
    }
    @low@ = u_min;
    @high@ = u_max;
  }
  @name@_retune(&state_, &parameters_);
  return true;
}

CallbackReturn @class@::on_configure(const rclcpp_lifecycle::State &)
{
  if (get_update_rate() != UPDATE_RATE) {
    RCLCPP_ERROR(
      get_node()->get_logger(),
      "update_rate = %u Hz: the controller was exported for %u Hz; set update_rate, of this "
      "controller or of the controller manager, or export again with another sample time",
      get_update_rate(), UPDATE_RATE);
    return CallbackReturn::ERROR;
  }
  if (!read_names() || !read_limits()) {
    return CallbackReturn::ERROR;
  }
  subscription_ = get_node()->create_subscription<Message>(
    "~/reference", rclcpp::SystemDefaultsQoS(), [this](std::shared_ptr<const Message> message) {
      if (message->data.size() != REFERENCES) {
        RCLCPP_ERROR(
          get_node()->get_logger(), "a reference with %zu numbers is ignored: must have %zu",
          message->data.size(), REFERENCES);
        return;
      }
      Received received;
      for (std::size_t i = 0; i < REFERENCES; i++) {
        received.numbers[i] = message->data[i];
      }
      received.message = ++messages_;
      received_.set(received);
    });
  return CallbackReturn::SUCCESS;
}

controller_interface::InterfaceConfiguration @class@::command_interface_configuration() const
{
  return {controller_interface::interface_configuration_type::INDIVIDUAL, command_names_};
}

controller_interface::InterfaceConfiguration @class@::state_interface_configuration() const
{
  return {controller_interface::interface_configuration_type::INDIVIDUAL, state_names_};
}

std::vector<hardware_interface::CommandInterface::SharedPtr>
@class@::on_export_reference_interfaces_list()
{
  std::vector<hardware_interface::CommandInterface::SharedPtr> exported;
  const std::string prefix = get_node()->get_name();
  const auto add = [&exported](const std::string & joint, const std::string & interface) {
      exported.push_back(std::make_shared<hardware_interface::CommandInterface>(joint, interface));
    };

  exported.reserve(REFERENCES);
  for (const auto & name : @reference_names@) {
    add(prefix + "/" + joint_of(name), interface_of(name));
  }
  for (const auto & further : FURTHER) {
    for (const auto & name : @reference_names@) {
      add(prefix + "/" + joint_of(name), interface_of(name) + "_" + further);
    }
  }
  return exported;
}

std::vector<hardware_interface::StateInterface::SharedPtr>
@class@::on_export_state_interfaces_list()
{
  std::vector<hardware_interface::StateInterface::SharedPtr> exported;
  const std::string prefix = get_node()->get_name();

  exported.push_back(std::make_shared<hardware_interface::StateInterface>(prefix, "status"));
@export_disturbances@  return exported;
}

CallbackReturn @class@::on_activate(const rclcpp_lifecycle::State &)
{
  @name@_reset(&state_);
  for (const auto & reference : ordered_exported_reference_interfaces_) {
    (void)reference->set_value(NOTHING);
  }
  old_ = messages_;
  acting_.fill(NOTHING);
  return CallbackReturn::SUCCESS;
}

CallbackReturn @class@::on_deactivate(const rclcpp_lifecycle::State &)
{
  for (auto & command : command_interfaces_) {
    const auto & interface = command.get_interface_name();

    if (interface == "effort" || interface == "velocity" || interface == "acceleration") {
      (void)command.set_value(0.0);
    }
  }
  return CallbackReturn::SUCCESS;
}

return_type @class@::update_reference_from_subscribers(
  const rclcpp::Time &, const rclcpp::Duration &)
{
  const auto received = received_.try_get();

  if (!received.has_value() || received->message <= old_) {
    return return_type::OK;
  }
  for (std::size_t i = 0; i < REFERENCES; i++) {
    if (!std::isnan(received->numbers[i])) {
      (void)ordered_exported_reference_interfaces_[i]->set_value(received->numbers[i]);
    }
  }
  return return_type::OK;
}

return_type @class@::update_and_write_commands(const rclcpp::Time &, const rclcpp::Duration &)
{
  // A number that can't be had in this sample is NaN: the controller holds the last one, or goes
  // on with the measurement that it expects, and the status says so.
  References r;
  std::array<double, AXES> y;
  std::array<double, ACTUATORS> u;
  std::array<double, ACTUATORS> applied;
  bool differs = false;

  for (std::size_t i = 0; i < REFERENCES; i++) {
    r[i] = ordered_exported_reference_interfaces_[i]->get_optional().value_or(NOTHING);
  }
  for (std::size_t i = 0; i < AXES; i++) {
    y[i] = state_interfaces_[i].get_optional().value_or(NOTHING);
  }
  @step@;
  for (std::size_t k = 0; k < ACTUATORS; k++) {
    const bool written = command_interfaces_[k].set_value(u[k]);
    const auto found = command_interfaces_[k].get_optional();

    // Joint limits may cut u; where it could not be written the command before acts.
    if (found.has_value()) {
      acting_[k] = *found;
    } else if (written) {
      acting_[k] = u[k];
    }
    applied[k] = std::isnan(acting_[k]) ? u[k] : acting_[k];
    differs = differs || applied[k] != u[k];
  }
  if (differs) {
    @name@_applied(&state_, @applied@);
  }
  const @name@_estimate estimate = @name@_get_estimate(&state_);
  (void)ordered_exported_state_interfaces_[0]->set_value(static_cast<double>(estimate.status));
@write_disturbances@  return return_type::OK;
}

}  // namespace @name@_ros2

PLUGINLIB_EXPORT_CLASS(
  @name@_ros2::@class@, controller_interface::ChainableControllerInterface)
