// See serial_end.h.

#include "serial_end.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <string.h>
#include <sys/inotify.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

#include <stdexcept>
#include <utility>

namespace {

void make_raw(int fd) {
  termios settings;
  if (tcgetattr(fd, &settings) != 0) return;
  cfmakeraw(&settings);
  cfsetspeed(&settings, B115200);
  tcsetattr(fd, TCSANOW, &settings);
}

}  // namespace

SerialEnd SerialEnd::make_pty(const std::string& link) {
  SerialEnd end;
  char name[128];
  if (openpty(&end.fd_, &end.slave_, name, nullptr, nullptr) != 0) {
    throw std::runtime_error(std::string("cannot make a pty: ") + strerror(errno));
  }
  make_raw(end.slave_);
  fcntl(end.fd_, F_SETFL, O_NONBLOCK);
  end.name_ = name;
  end.watch_ = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
  end.watch();
  if (!link.empty()) {
    struct stat status;
    if (lstat(link.c_str(), &status) == 0 && S_ISLNK(status.st_mode)) unlink(link.c_str());
    if (symlink(name, link.c_str()) != 0) {
      throw std::runtime_error("cannot make the link " + link + ": " + strerror(errno));
    }
    end.link_ = link;
  }
  return end;
}

SerialEnd SerialEnd::use_port(const std::string& path) {
  SerialEnd end;
  end.path_ = end.name_ = path;
  end.reopen();
  return end;
}

SerialEnd::SerialEnd(SerialEnd&& other) {
  std::swap(fd_, other.fd_);
  std::swap(watch_, other.watch_);
  std::swap(watched_, other.watched_);
  std::swap(open_, other.open_);
  std::swap(slave_, other.slave_);
  std::swap(name_, other.name_);
  std::swap(link_, other.link_);
  std::swap(path_, other.path_);
}

SerialEnd::~SerialEnd() {
  if (!link_.empty()) unlink(link_.c_str());
  if (watch_ >= 0) close(watch_);
  if (slave_ >= 0) close(slave_);
  if (fd_ >= 0) close(fd_);
}

void SerialEnd::reopen() {
  if (fd_ >= 0 || path_.empty()) return;
  fd_ = open(path_.c_str(), O_RDWR | O_NOCTTY | O_NONBLOCK);
  if (fd_ >= 0) make_raw(fd_);
}

void SerialEnd::lost() {
  if (path_.empty()) return;
  close(fd_);
  fd_ = -1;
}

size_t SerialEnd::read(uint8_t* bytes, size_t size) {
  if (fd_ < 0) return 0;
  const ssize_t count = ::read(fd_, bytes, size);
  if (count > 0) return size_t(count);
  if (count == 0 || (errno != EAGAIN && errno != EINTR)) lost();
  return 0;
}

void SerialEnd::write(const std::string& bytes) {
  if (fd_ < 0 || bytes.empty()) return;
  const ssize_t count = ::write(fd_, bytes.data(), bytes.size());
  if (count == ssize_t(bytes.size())) return;
  if (count < 0 && errno != EAGAIN && errno != EINTR) {
    lost();
  } else if (slave_ >= 0) {
    // Nobody has read for a while. The next reader of the pty must not receive old bytes.
    tcflush(slave_, TCIFLUSH);
    ++flushes_;
  }
}

void SerialEnd::watch() { watched_ = inotify_add_watch(watch_, name_.c_str(), IN_OPEN | IN_CLOSE); }

bool SerialEnd::was_opened() {
  bool opened = false;
  bool closed = false;
  inotify_event event;  // the pty is no folder: no name follows
  while (watch_ >= 0 && ::read(watch_, &event, sizeof event) == ssize_t(sizeof event)) {
    if (event.mask & IN_OPEN) {
      opened = opened || open_ == 0;
      ++open_;
    } else if (event.mask & IN_CLOSE) {
      closed = true;
      if (open_ > 0) --open_;
    }
  }
  // Two programs may have closed it: inotify reports equal events that follow each other as one.
  if (closed && open_ > 0 && !is_open_elsewhere()) open_ = 0;
  return opened;
}

bool SerialEnd::is_open_elsewhere() {
  inotify_rm_watch(watch_, watched_);
  close(slave_);
  pollfd master = {fd_, 0, 0};
  poll(&master, 1, 0);
  slave_ = open(name_.c_str(), O_RDWR | O_NOCTTY);
  watch();
  return (master.revents & POLLHUP) == 0;
}

unsigned SerialEnd::baud() const {
  termios settings;
  if (slave_ < 0 || tcgetattr(slave_, &settings) != 0) return 0;
  switch (cfgetospeed(&settings)) {
    case B9600: return 9600;
    case B19200: return 19200;
    case B57600: return 57600;
    case B115200: return 115200;
    default: return 0;
  }
}
