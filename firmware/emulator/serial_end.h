// The computer's end of the board's UART: a pty of our own, or an existing tty (a socat end, say).

#ifndef EMULATOR_SERIAL_END_H
#define EMULATOR_SERIAL_END_H

#include <cstdint>
#include <string>

class SerialEnd {
 public:
  // Makes a pty, with a symbolic link to it at `link` unless that is empty.
  static SerialEnd make_pty(const std::string& link);
  // Uses the tty at `path`; waits for it and opens it again when it vanishes.
  static SerialEnd use_port(const std::string& path);
  ~SerialEnd();
  SerialEnd(SerialEnd&& other);

  const std::string& name() const { return name_; }

  // The descriptor to poll for input; -1 while the tty is absent.
  int descriptor() const { return fd_; }

  // Reads what is there, at most `size` bytes.
  size_t read(uint8_t* bytes, size_t size);

  // Writes without waiting. A wire that nobody reads loses what is sent over it.
  void write(const std::string& bytes);

  // How often bytes that nobody had read were thrown away.
  unsigned flushes() const { return flushes_; }

  // Tries to open a tty that is absent; to be called now and then.
  void reopen();

 private:
  SerialEnd() {}
  void lost();

  int fd_ = -1;
  unsigned flushes_ = 0;
  int slave_ = -1;  // of our own pty: held open, so that it stays raw and never hangs up
  std::string name_;
  std::string link_;
  std::string path_;
};

#endif
