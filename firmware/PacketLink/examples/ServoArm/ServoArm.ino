// A servo at pin 9 follows ~servo, in degrees, -90 … 90. It gets no pulses before the first command. Timer1 makes them
// without the processor, so they do not tremble: ATmega328P (Nano, Uno). See firmware/README.md.

#include <PacketLink.h>

const int16_t kCentreUs = 1500;
const int16_t kQuarterUs = 900;  // for 90 degrees: see the data sheet of your servo

const char kRows[] PROGMEM =
    "firmware: servo 1.0\n"
    "servo: {type: 33, direction: to_board, ros_type: std_msgs/Float32, layout: '<h', fields: [data], scale: 0.01,"
    " minimum: -90, maximum: 90}\n";

struct PACKED Servo {
  int16_t centidegrees;
};

PacketLink bridge(Serial);

void handle_servo(const Servo& servo) {
  const int16_t angle = constrain(servo.centidegrees, -9000, 9000);  // the line has no checksum
  OCR1A = 2 * (kCentreUs + static_cast<int32_t>(angle) * kQuarterUs / 9000) - 1;
  TCCR1A |= _BV(COM1A1);
}

void setup() {
  pinMode(9, OUTPUT);
  TCCR1A = _BV(WGM11);  // a pulse every 20 ms, in steps of 0.5 us
  TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS11);
  ICR1 = 39999;
  Serial.begin(115200);
  bridge.on<Servo>(33, handle_servo);
  bridge.announce(kRows);
}

void loop() {
  bridge.update();
}
