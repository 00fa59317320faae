// See control.h.

#include "control.h"

#include <errno.h>
#include <fcntl.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <stdexcept>

namespace {
const size_t kLineMax = 4096;
}

Control::Control(const std::string& path, std::function<std::string(const std::string&)> answer, bool copies)
    : path_(path), answer_(std::move(answer)), copies_(copies) {
  sockaddr_un address;
  memset(&address, 0, sizeof address);
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof address.sun_path) {
    throw std::runtime_error("the path of the control socket is too long: " + path);
  }
  strcpy(address.sun_path, path.c_str());
  listener_ = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  struct stat status;
  if (stat(path.c_str(), &status) == 0 && S_ISSOCK(status.st_mode)) unlink(path.c_str());
  if (listener_ < 0 || bind(listener_, reinterpret_cast<sockaddr*>(&address), sizeof address) != 0 ||
      listen(listener_, 8) != 0) {
    throw std::runtime_error("cannot make the control socket " + path + ": " + strerror(errno));
  }
}

Control::~Control() {
  for (const auto& client : clients_) close(client.first);
  if (listener_ < 0) return;
  close(listener_);
  unlink(path_.c_str());
}

void Control::add_to(std::vector<pollfd>& descriptors) const {
  if (listener_ >= 0) descriptors.push_back(pollfd{listener_, POLLIN, 0});
  for (const auto& client : clients_) descriptors.push_back(pollfd{client.first, POLLIN, 0});
}

void Control::take_client() {
  // A copy has nothing else to do than to wait for its client.
  const int client = accept4(listener_, nullptr, nullptr, SOCK_CLOEXEC | (copies_ ? 0 : SOCK_NONBLOCK));
  if (client < 0) return;
  if (copies_) {
    if (fork() != 0) {
      close(client);
      return;
    }
    close(listener_);
    listener_ = -1;
  }
  clients_[client];
}

void Control::handle(const pollfd& descriptor) {
  if (descriptor.revents == 0) return;
  if (descriptor.fd == listener_) {
    take_client();
    return;
  }
  const auto found = clients_.find(descriptor.fd);
  if (found == clients_.end()) return;
  char bytes[1024];
  const ssize_t count = read(descriptor.fd, bytes, sizeof bytes);
  bool gone = count == 0 || (count < 0 && errno != EAGAIN && errno != EINTR);
  std::string& pending = found->second;
  if (count > 0) pending.append(bytes, size_t(count));
  size_t end;
  while (!gone && (end = pending.find('\n')) != std::string::npos) {
    const std::string reply = answer_(pending.substr(0, end)) + "\n";
    pending.erase(0, end + 1);
    gone = send(descriptor.fd, reply.data(), reply.size(), MSG_NOSIGNAL) != ssize_t(reply.size());
  }
  if (gone || pending.size() > kLineMax) {
    close(descriptor.fd);
    clients_.erase(found);
  }
}
