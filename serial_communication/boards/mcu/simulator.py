"""The simulated sensor board: two range sensors and an IMU, or six ADC channels.

It reads nothing but settings.

    ranges    an object moves to and fro before each sensor, up to 2.4 m away; beyond 2 m the
              sensor reads 8190, as a VL53L0X does; one reading in 200 times out (0xFFFF)
    heading   turns clockwise by 20 °/s, so it passes 360° every 18 s
    pitch, roll  sway by a few degrees
    ADC       12 bits: sines of different periods, with noise

The board sends every 50 ms (20 Hz), as its source does; SEQ counts every frame and starts at 0.
"""
import argparse
import math
from random import Random
from typing import Any, Iterable, Optional, Sequence

from ...framing.rows import Row, Setting
from ...framing.stream import SETTING, Frame
from ...simulation.board import Board, positive
from ...simulation.custom_messages import CustomMessagePlayer
from ...transport.pace import Every
from . import DESCRIPTION, wire

RATE = 20.0              # Hz
OUT_OF_RANGE = 8190      # mm; the sensor's reading where nothing is in range
FARTHEST = 2000          # mm
TURN_RATE = 20.0         # degrees/s, clockwise
TIME_OUT_SHARE = 0.005   # share of a sensor's readings that time out


class SensorBoard(Board):
    """See the module.

    Args:
        rate: frames a second.
        adc: send the six ADC channels instead of the sensor status.
        imu: whether there is an IMU; without one the angles are unknown.
        seed: seed of the noise and the timeouts.
        custom: custom messages, sent in addition.
        announcement: the text to announce; None: nothing.
        settings: that the board has.
    """

    decoder: wire.Decoder
    NAME = DESCRIPTION.name
    SUMMARY = 'sensor board: two ranges and orientation, or six ADC channels'
    FAULTS = ('drop=0.005 cut=0.005 lose=0.005 flip=0.01 insert=0.005 double=0.005 '
              'delay=0.005 silence=0.5/min reset=0.5/min')
    READS = False      # but settings, which are sent again whatever is lost of them
    HAS_CLOCK = True
    CHATTER = (b'ets Jun  8 2016 00:22:57\r\n\r\nrst:0x1 (POWERON_RESET),boot:0x13 '
               b'(SPI_FAST_FLASH_BOOT)\r\nconfigsip: 0, SPIWP:0xee\r\nload:0x3fff0030,len:1184\r\n'
               b'entry 0x400805f0\r\n')

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument('--rate', type=positive, default=RATE, metavar='HZ',
                            help='frames a second (%(default)g)')
        parser.add_argument('--adc', action='store_true',
                            help='send six ADC channels instead of the sensor status')
        parser.add_argument('--no-imu', action='store_true',
                            help='the IMU does not answer: the angles are unknown')

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> 'SensorBoard':
        return cls(options.rate, options.adc, options.seed, options.config,
                   not options.no_imu, options.announcement, options.config.settings)

    def __init__(self, rate: float = RATE, adc: bool = False, seed: int = 0,
                 custom: Iterable[Row] = (), imu: bool = True,
                 announcement: Optional[bytes] = None, settings: Sequence[Setting] = ()) -> None:
        self._custom = CustomMessagePlayer(custom, announcement, settings)
        super().__init__(wire.Decoder(row.message for row in settings))
        self.seq = 0        # of the next frame
        self._adc = adc
        self._imu = imu
        self._period = 1 / rate
        self._random = Random(f'{seed} sensors')
        self._pace = Every(self._period, 0.0)
        self._on_since = 0.0

    # -- hooks ----------------------------------------------------------------------------

    def power_on(self, now: float) -> None:
        self.seq = 0
        self.decoder.reset()
        self._on_since = now
        self._pace = Every(self._period, now)
        self._custom.power_on(now)

    def advance(self, now: float) -> Optional[float]:
        measured = self._custom.messages(now, self.line.micros())
        if self._pace.passed(now):
            measured.insert(0, self.channels(now) if self._adc else self.status(now))
        for message in measured:
            if self.line.sends_time:
                self._send(wire.Time(self.line.micros()))
            self._send(message)
        for message in self._custom.announcements(now):
            self._send(message)
        return min(self._pace.due, self._custom.due() or math.inf)

    def frame(self, frame: Frame, now: float) -> None:
        if frame.type == SETTING and not frame.cause:
            for answer in self._custom.use(frame.message):
                self.line.say(str(answer))
                self._send(answer)

    def _send(self, message: Any) -> None:
        self.line.send(wire.encode(message, self.seq))
        self.seq = (self.seq + 1) % 256

    # -- measurements -----------------------------------------------------------------------

    def status(self, now: float) -> wire.SensorStatus:
        """What the range sensors and the IMU measure."""
        gauss = self._random.gauss
        ranges = (self._range(1250 + 1150 * math.sin(now / 3)),
                  self._range(700 + 450 * math.sin(now / 1.7 + 2)))
        if not self._imu:
            return wire.SensorStatus(*ranges, math.nan, math.nan, math.nan)
        return wire.SensorStatus(
            *ranges,
            (now - self._on_since) * TURN_RATE % 360,
            4 * math.sin(now / 2.3) + gauss(0, 0.05),
            6 * math.sin(now / 3.1) + gauss(0, 0.05))

    def channels(self, now: float) -> wire.AdcStatus:
        """What the ADC measures."""
        return wire.AdcStatus(*(
            min(max(round(2048 + 1500 * math.sin(now / (1 + channel) + channel)
                          + self._random.gauss(0, 4)), 0), 4095)
            for channel in range(6)))

    def _range(self, distance: float) -> int:
        if self._random.random() < TIME_OUT_SHARE:
            return wire.RANGE_TIMED_OUT
        if distance > FARTHEST:
            return OUT_OF_RANGE
        return max(round(distance + self._random.gauss(0, distance / 200)), 20)


BOARD = SensorBoard
