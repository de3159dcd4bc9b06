// The controller manager of a test: interfaces of one controller, and a plant.
#pragma once
#include <cmath>
#include <cstring>
#include <limits>

#include "controller_interface/chainable_controller_interface.hpp"
#include "realtime_tools/realtime_thread_safe_box.hpp"
#include "std_msgs/msg/float64_multi_array.hpp"

std::shared_ptr<controller_interface::ChainableControllerInterface> exported_class();

using controller_interface::CallbackReturn;
using Message = std_msgs::msg::Float64MultiArray;
constexpr double NOTHING = std::numeric_limits<double>::quiet_NaN();

struct Loop
{
  Loop(unsigned int rate, std::vector<std::string> commands, std::vector<std::string> states)
  {
    controller->update_rate = rate;
    controller->get_node()->parameters["command_interfaces"] = commands;
    controller->get_node()->parameters["state_interfaces"] = states;
  }
  void set(const std::string & key, std::vector<double> values) { controller->get_node()->parameters[key] = values; }
  bool configure() { return controller->on_init() == CallbackReturn::SUCCESS && controller->on_configure({}) == CallbackReturn::SUCCESS; }
  bool start()
  {
    std::vector<hardware_interface::LoanedCommandInterface> lent_commands;
    std::vector<hardware_interface::LoanedStateInterface> lent_states;
    if (!configure()) {
      return false;
    }
    controller->export_interfaces();
    for (const auto & name : controller->command_interface_configuration().names) {
      commands.push_back(std::make_shared<hardware_interface::CommandInterface>(name.substr(0, name.rfind('/')), name.substr(name.rfind('/') + 1)));
      lent_commands.emplace_back(commands.back());
    }
    for (const auto & name : controller->state_interface_configuration().names) {
      states.push_back(std::make_shared<hardware_interface::StateInterface>(name.substr(0, name.rfind('/')), name.substr(name.rfind('/') + 1)));
      lent_states.emplace_back(states.back());
    }
    controller->assign_interfaces(std::move(lent_commands), std::move(lent_states));
    return controller->on_activate({}) == CallbackReturn::SUCCESS;
  }
  void send(std::vector<double> numbers)
  {
    auto subscription = std::any_cast<rclcpp::Subscription<Message>::SharedPtr>(controller->get_node()->subscription);
    auto message = std::make_shared<Message>();
    message->data = numbers;
    subscription->callback(message);
  }
  void update() { (void)controller->update({}, {}); }
  double command(std::size_t k) const { return *commands[k]->get_optional(); }

  std::shared_ptr<controller_interface::ChainableControllerInterface> controller = exported_class();
  std::vector<hardware_interface::CommandInterface::SharedPtr> commands;
  std::vector<hardware_interface::StateInterface::SharedPtr> states;
};

inline bool same(double a, double b) { return std::memcmp(&a, &b, sizeof a) == 0; }

// Noise that every C++ library draws alike.
inline double noise()
{
  static unsigned int state = 1;
  state = state * 1103515245u + 12345u;
  return static_cast<double>(state >> 16) / 65536.0 - 0.5;
}
