// Stand-in for tests: a subscription keeps its callback.
#pragma once
#include <functional>
#include <memory>
namespace rclcpp
{
template <typename MessageT>
class Subscription
{
public:
  using SharedPtr = std::shared_ptr<Subscription<MessageT>>;
  std::function<void(std::shared_ptr<const MessageT>)> callback;
};
}  // namespace rclcpp
