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
  // `answer` is called with each line and returns the reply, both without the newline. `copies`: each client gets a
  // copy of this process, with all that it has computed so far, which ends with it.
  Control(const std::string& path, std::function<std::string(const std::string&)> answer, bool copies);
  ~Control();
  Control(const Control&) = delete;

  void add_to(std::vector<pollfd>& descriptors) const;
  void handle(const pollfd& descriptor);
  // Whether this is a copy whose client has gone.
  bool is_over() const { return listener_ < 0 && clients_.empty(); }

 private:
  void take_client();

  std::string path_;
  std::function<std::string(const std::string&)> answer_;
  bool copies_;
  int listener_ = -1;
  std::map<int, std::string> clients_;  // descriptor and the incomplete line
};

#endif
