// Stand-in for tests: the class must be one of its base.
#pragma once
#include <memory>
#define PLUGINLIB_EXPORT_CLASS(kind, base) \
  std::shared_ptr<base> exported_class() { return std::make_shared<kind>(); }
