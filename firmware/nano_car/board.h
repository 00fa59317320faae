// Pins and constants of the model car; adapt them to another car.

#ifndef NANO_CAR_BOARD_H
#define NANO_CAR_BOARD_H

#include <Arduino.h>

const uint32_t kBaud = 115200;

// Fixed by the chip: the encoder needs INT0, the motor Timer2's OC2B, the servo Timer1's OC1A.
const uint8_t kEncoderPin = 2;
const uint8_t kMotorPwmPin = 3;
const uint8_t kServoPin = 9;

const uint8_t kMotorForwardPin = 7;   // H-bridge IN1
const uint8_t kMotorBackwardPin = 8;  // H-bridge IN2
const uint8_t kLedLeftPin = 5;
const uint8_t kLedRightPin = 6;
const uint8_t kLedBrakePin = 12;
const uint8_t kSteeringFeedbackPin = A0;
const uint8_t kBatteryPin = A1;
// A4 and A5 are the I2C bus of the MPU6050.
// Of the example of custom messages; the gripper needs Timer2's other output, OC2A.
const uint8_t kForcePin = A6;
const uint8_t kGripperPin = 11;

// 30 kOhm from the battery to the pin, 10 kOhm from the pin to ground: 20 V at full scale.
const float kBatteryDivider = 4.0f;
const float kAdcReference = 5.0f;

const uint16_t kServoMinUs = 1000;
const uint16_t kServoMaxUs = 2000;
const uint16_t kServoCentreUs = 1500;

// The reference car averages its offsets for over five minutes.
#ifndef CALIBRATION_SECONDS
#define CALIBRATION_SECONDS 310
#endif

#endif
