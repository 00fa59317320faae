// A board on the bus with three functions: one with data, one with a reply, and a slow one that can be
// stopped. For an ATmega328P. It announces them: the bridge asks for the rows with `bus/announcements: true`.
//
// The port belongs to the bridge: do not Serial.print to it.
//
// The built-in lift, gimbal and environment are kFunctionLift, kFunctionGimbal and
// kFunctionEnvironment; firmware/ctrl_board has them.

#include <BusSlave.h>
#include <safe_board.h>
#include <avr_i2c.h>  // unlike Wire, its waits are bounded, and it frees a blocked bus

const char kRows[] PROGMEM =
    "firmware: slave 1.0\n"
    "pump: {cmd2: 0x30, srv_type: std_srvs/SetBool, request: {layout: '<?', fields: [data]}}\n"
    "water: {cmd2: 0x32, ros_type: sensor_msgs/Temperature, period: 1.0,"
    " reply: {layout: '<h', fields: [temperature], scale: 0.00390625}}\n"
    "door: {cmd2: 0x33, srv_type: std_srvs/SetBool, request: {layout: '<?', fields: [data]}, timeout: 6.0}\n"
    "halt: {cmd2: 0x2F, srv_type: std_srvs/Trigger, repeatable: true, interrupts: true}\n";

const uint8_t kPumpPin = 11;
const uint8_t kDoorPin = 5;       // its motor
const uint8_t kDirectionPin = 6;  // high: opens
const uint8_t kOutputs[] = {kPumpPin, kDoorPin, kDirectionPin};  // 10 kOhm to ground on each: see safe_board.h
const uint32_t kDoorMs = 4000;
const uint8_t kThermometer = 0x48;  // an LM75, on A4 and A5

struct PACKED Pump {
  uint8_t on;
};
struct PACKED Door {
  uint8_t open;
};
struct PACKED Water {
  int16_t temperature;  // 1/256 degree Celsius
};

BusSlave bus(Serial);
uint32_t door_since_ms;
bool door_stopped;

BusResult pump(const Pump& request) {
  digitalWrite(kPumpPin, request.on != 0);
  return BusResult::ok();
}

BusResult water() {
  uint8_t raw[2];
  if (!i2c_read_registers(kThermometer, 0, raw, sizeof raw)) return BusResult::failed(kErrorOperation);
  Water water;
  water.temperature = int16_t(uint16_t(raw[0]) << 8 | raw[1]);
  return BusResult::ok(water);
}

// A slow function must not wait: it starts the move, and door_moves() is called until the move has ended.
BusResult door(const Door& request) {
  if (request.open > 1) return BusResult::failed(kErrorMalformed);
  digitalWrite(kDirectionPin, request.open);
  digitalWrite(kDoorPin, HIGH);
  door_since_ms = millis();
  door_stopped = false;
  return BusResult::pending();
}

BusResult door_moves() {
  if (!door_stopped && millis() - door_since_ms < kDoorMs) return BusResult::pending();
  digitalWrite(kDoorPin, LOW);
  return door_stopped ? BusResult::failed(kErrorOperation) : BusResult::ok();
}

void stop() {
  digitalWrite(kDoorPin, LOW);
  door_stopped = true;
}

void setup() {
  safe_begin(kOutputs);  // the pump and the door stop when the program hangs
  i2c_begin();
  i2c_write_register(kThermometer, 1, 0);  // it measures; i2c_transfer() writes and reads any bytes
  Serial.begin(115200);
  bus.on<Pump>(0x30, pump);
  bus.on(0x32, water);
  bus.on<Door>(0x33, door);
  bus.on_pending(door_moves);
  bus.on_stop(stop);
  bus.announce(kRows);
}

void loop() {
  safe_update();
  bus.update();
}
