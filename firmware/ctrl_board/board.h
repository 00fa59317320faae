// Pins and constants of the control board; adapt them to another robot.

#ifndef CTRL_BOARD_BOARD_H
#define CTRL_BOARD_BOARD_H

#include <Arduino.h>

const uint32_t kBaud = 115200;

const uint8_t kLiftStepPin = 3;
const uint8_t kLiftDirectionPin = 4;  // high: up
const uint8_t kPanStepPin = 5;
const uint8_t kPanDirectionPin = 6;  // high: left
const uint8_t kTiltStepPin = 7;
const uint8_t kTiltDirectionPin = 8;  // high: up
// End switches of the lift, normally closed, to ground: a broken wire reads as an open switch and stops the lift.
const uint8_t kLiftTopPin = 9;
const uint8_t kLiftBottomPin = 10;
const uint8_t kSmokePin = A0;
// A4 and A5 are the I2C bus of the SHT3x.
// Of the example of custom functions.
const uint8_t kPumpPin = 11;
const uint8_t kTankPin = A1;

// Low from the start; 10 kOhm to ground on each: see safe_board.h.
const uint8_t kOutputs[] = {kLiftStepPin, kLiftDirectionPin, kPanStepPin, kPanDirectionPin, kTiltStepPin,
                            kTiltDirectionPin,
#ifdef CUSTOM_MESSAGES
                            kPumpPin
#endif
};

// Leadscrew with 8 mm a turn, 200 steps a turn.
const uint16_t kLiftStepsPerMm = 25;
const uint16_t kLiftStepsPerSecond = 2000;
// 200 steps a turn, geared 18:1.
const uint16_t kGimbalStepsPerDegree = 10;
const uint16_t kGimbalStepsPerSecond = 900;
// How far the gimbal may turn from its position at power-up, degrees.
const int16_t kPanLimit = 170;
const int16_t kTiltLimit = 90;

#endif
