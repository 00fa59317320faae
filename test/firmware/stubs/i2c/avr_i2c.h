// A test defines the transfer.
#include <stdint.h>
namespace serial_communication {
bool i2c_transfer(uint8_t, const uint8_t*, uint8_t, uint8_t*, uint8_t);
}
