// See world.h.

#include "world.h"

#include <cmath>
#include <cstdio>

namespace {
const size_t kHistoryLength = 200;
}

void Values::reading(const std::string& name, std::function<double()> get) {
  entries_[name] = Entry{std::move(get), nullptr};
}

void Values::variable(const std::string& name, double* storage) {
  variable(name, [storage] { return *storage; }, [storage](double value) { *storage = value; });
}

void Values::variable(const std::string& name, std::function<double()> get, std::function<void(double)> set) {
  entries_[name] = Entry{std::move(get), std::move(set)};
}

void Values::record(const std::string& name, double value) {
  auto& history = histories_[name];
  if (history.empty()) {
    reading(name, [this, name] { return histories_[name].back().second; });
  } else if (history.back().second == value) {
    return;
  }
  history.emplace_back(clock(), value);
  if (history.size() > kHistoryLength) history.pop_front();
}

bool Values::has(const std::string& name) const { return entries_.count(name) != 0; }

double Values::get(const std::string& name) const { return entries_.at(name).get(); }

bool Values::set(const std::string& name, double value) {
  const auto found = entries_.find(name);
  if (found == entries_.end() || !found->second.set) return false;
  found->second.set(value);
  return true;
}

std::string Values::history(const std::string& name) const {
  std::string line;
  const auto found = histories_.find(name);
  if (found == histories_.end()) return line;
  for (const auto& change : found->second) {
    char text[64];
    snprintf(text, sizeof text, "%s%.6f %.10g", line.empty() ? "" : " ", change.first, change.second);
    line += text;
  }
  return line;
}

std::string Values::names() const {
  std::string line;
  for (const auto& entry : entries_) line += (line.empty() ? "" : " ") + entry.first;
  return line;
}

OutputPins::OutputPins(Mcu& mcu, Values& values) : mcu_(mcu) { values.variable("pull_downs", &pull_downs_); }

bool OutputPins::level(char port, int bit) const {
  if (!mcu_.input_pin(port, bit)) return mcu_.output_pin(port, bit);
  return pull_downs_ == 0 && (noise_ >> ((port - 'B') * 8 + bit) & 1);
}

bool OutputPins::step() {
  noise_ = noise_ * 1664525 + 1013904223;
  noise_ ^= noise_ >> 16;  // the low bits of such a sequence are hardly random
  return pull_downs_ == 0;
}

double wave(double seconds, double period, double low, double high) {
  return low + (high - low) * (1 - std::cos(2 * M_PI * seconds / period)) / 2;
}
