// Chainable controller of ros2_control around the controller @name@ of quell, see README.md.
#ifndef @NAME@_CONTROLLER_HPP_
#define @NAME@_CONTROLLER_HPP_

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "controller_interface/chainable_controller_interface.hpp"
#include "hardware_interface/handle.hpp"
#include "rclcpp/subscription.hpp"
#include "rclcpp/time.hpp"
#include "rclcpp_lifecycle/state.hpp"
#include "realtime_tools/realtime_thread_safe_box.hpp"
#include "std_msgs/msg/float64_multi_array.hpp"

#include "@name@.h"

namespace @name@_ros2
{

constexpr std::size_t AXES = @axes@;
constexpr std::size_t ACTUATORS = @actuators@;
// Numbers in ~/reference: @reference_meaning@.
constexpr std::size_t REFERENCES = @references@;

class @class@ : public controller_interface::ChainableControllerInterface
{
public:
  controller_interface::CallbackReturn on_init() override;
  controller_interface::InterfaceConfiguration command_interface_configuration() const override;
  controller_interface::InterfaceConfiguration state_interface_configuration() const override;
  controller_interface::CallbackReturn on_configure(
    const rclcpp_lifecycle::State & previous_state) override;
  controller_interface::CallbackReturn on_activate(
    const rclcpp_lifecycle::State & previous_state) override;
  controller_interface::CallbackReturn on_deactivate(
    const rclcpp_lifecycle::State & previous_state) override;
  controller_interface::return_type update_reference_from_subscribers(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;
  controller_interface::return_type update_and_write_commands(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;

protected:
  std::vector<hardware_interface::StateInterface::SharedPtr>
  on_export_state_interfaces_list() override;
  std::vector<hardware_interface::CommandInterface::SharedPtr>
  on_export_reference_interfaces_list() override;

private:
  using References = std::array<double, REFERENCES>;
  using Message = std_msgs::msg::Float64MultiArray;

  struct Received
  {
    References numbers{};
    std::uint64_t message{0};  // counts from 1; 0 is none
  };

  bool read_names();
  bool read_limits();

  std::vector<std::string> command_names_;
  std::vector<std::string> state_names_;
  @name@_parameters parameters_{};
  @name@_state state_{};
  rclcpp::Subscription<Message>::SharedPtr subscription_;
  // What came last in ~/reference; reading does not clear it, so it acts until another one comes.
  realtime_tools::RealtimeThreadSafeBox<Received> received_;
  std::atomic<std::uint64_t> messages_{0};  // counts those that came in ~/reference
  std::uint64_t old_{0};  // messages up to this one came before the activation: they do not act
  std::array<double, ACTUATORS> acting_{};  // commands as they were read back; NaN before
};

}  // namespace @name@_ros2

#endif  // @NAME@_CONTROLLER_HPP_
