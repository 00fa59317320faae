// The computer's end of the board's UART: a new pty, or an existing tty (such as a socat end).

#ifndef EMULATOR_SERIAL_END_H
#define EMULATOR_SERIAL_END_H

#include <cstdint>
#include <string>

class SerialEnd {
 public:
  // Makes a pty, with a symbolic link to it at `link` unless that is empty.
  static SerialEnd make_pty(const std::string& link);
  // Uses the tty at `path`: waits for it, and opens it again after it was removed.
  static SerialEnd use_port(const std::string& path);
  ~SerialEnd();
  SerialEnd(SerialEnd&& other);

  const std::string& name() const { return name_; }

  // The descriptor to poll for input; -1 while the tty is absent.
  int descriptor() const { return fd_; }

  // Reads the available bytes, at most `size`.
  size_t read(uint8_t* bytes, size_t size);

  // Writes without waiting. If nobody reads, the bytes are lost, as on a wire.
  void write(const std::string& bytes);

  // Whether the new pty has been opened since the last call, while no other program had it open.
  bool was_opened();
  // The speed of the new pty that the last program set, bit/s; 0: none that a Nano is used with.
  unsigned baud() const;

  // How often unread bytes were dropped.
  unsigned flushes() const { return flushes_; }

  // Tries to open an absent tty; has to be called regularly.
  void reopen();

 private:
  SerialEnd() {}
  void lost();
  void watch();
  bool is_open_elsewhere();

  int fd_ = -1;
  unsigned flushes_ = 0;
  int watch_ = -1;    // inotify: the new pty is opened and closed
  int watched_ = -1;  // the pty in it
  int open_ = 0;      // how often it is open in other programs
  int slave_ = -1;    // of the new pty: kept open, so that it stays raw and never hangs up
  std::string name_;
  std::string link_;
  std::string path_;
};

#endif
