// Stand-in for tests.
#pragma once
namespace rclcpp
{
class Time {};
class Duration {};
}  // namespace rclcpp
