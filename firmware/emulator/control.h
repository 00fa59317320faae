// The control channel: a Unix socket; a client writes one line and receives one line.

#ifndef EMULATOR_CONTROL_H
#define EMULATOR_CONTROL_H

#include <poll.h>

#include <functional>
#include <map>
#include <string>
#include <vector>

class Control {
 public:
  // `answer` is called with each line and returns the reply, both without the newline.
  Control(const std::string& path, std::function<std::string(const std::string&)> answer);
  ~Control();
  Control(const Control&) = delete;

  void add_to(std::vector<pollfd>& descriptors) const;
  void handle(const pollfd& descriptor);

 private:
  std::string path_;
  std::function<std::string(const std::string&)> answer_;
  int listener_ = -1;
  std::map<int, std::string> clients_;  // descriptor and the incomplete line
};

#endif
