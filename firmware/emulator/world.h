// What surrounds an emulated board: named values that a control client reads and sets, and their history.

#ifndef EMULATOR_WORLD_H
#define EMULATOR_WORLD_H

#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "mcu.h"

class Values {
 public:
  // Emulated seconds, for the history.
  std::function<double()> clock;

  // A read-only number.
  void reading(const std::string& name, std::function<double()> get);
  // A number that a client may set.
  void variable(const std::string& name, double* storage);
  void variable(const std::string& name, std::function<double()> get, std::function<void(double)> set);
  // An output of the board: every change is recorded with its time.
  void record(const std::string& name, double value);

  bool has(const std::string& name) const;
  double get(const std::string& name) const;
  // False: the name does not exist or cannot be set.
  bool set(const std::string& name, double value);
  // "time value time value …", oldest first; empty for a name that is no recorded output.
  std::string history(const std::string& name) const;
  std::string names() const;

 private:
  struct Entry {
    std::function<double()> get;
    std::function<void(double)> set;
  };
  std::map<std::string, Entry> entries_;
  std::map<std::string, std::deque<std::pair<double, double>>> histories_;
};

// The board's outputs as what is connected to them sees them. While the program drives a pin neither high nor low, as
// in the bootloader, its pull-down resistor keeps it low. Without one it picks up noise.
class OutputPins {
 public:
  // Adds the value `pull_downs`: whether the resistors are fitted.
  OutputPins(Mcu& mcu, Values& values);

  bool level(char port, int bit) const;
  // The noise changes; to be called at each step of the world. False: there is none.
  bool step();

 private:
  Mcu& mcu_;
  double pull_downs_ = 1;
  uint32_t noise_ = 1;  // a bit for each pin
};

class World {
 public:
  virtual ~World() {}

  Values values;

 protected:
  // A step of the world, in emulated time: fine enough for an encoder edge.
  static constexpr double kStep = 250e-6;
};

// `still`: only the board and clients change the world.
std::unique_ptr<World> make_car_world(Mcu& mcu, bool still);
std::unique_ptr<World> make_ctrl_world(Mcu& mcu, bool still);
std::unique_ptr<World> make_range_world(Mcu& mcu, bool still);
// A base with two wheels, which only its motors move.
std::unique_ptr<World> make_diff_world(Mcu& mcu);
// Nothing is connected but what clients set.
std::unique_ptr<World> make_pins_world(Mcu& mcu);

// A slow oscillation between two values, for a demo.
double wave(double seconds, double period, double low, double high);

#endif
