"""Settings, exactly: of a car that loses requests and answers, is reset, and calibrates."""
import contextlib
import itertools
import json
import math
import struct
import threading
import time
from typing import Any, Dict, List, Optional

import rospy
from dynamic_reconfigure.msg import Config, DoubleParameter, IntParameter
from dynamic_reconfigure.srv import Reconfigure

import by_definition as codec
from . import exact_node
from .boards import Packet
from .exact_car import CALIBRATION_TIMEOUT, STOPS, check_timeout
from .exact_data import REPORTED
from .rig import Rig
from .robot import NODE

_LAYOUTS = {1: '<f', 2: '<H'}
_DEFAULTS = {1: 1.0, 2: 100}
_MOST_USED = {1: 8.0, 2: 1000}     # the board limits them
_ANSWER = 0.6           # s until a set is answered
_IN_USE_IN = 3.0        # s until its values are in use, while requests and answers are lost
START = 2.5
PARAMETERS: Dict[str, Any] = {'arduino/settings': json.dumps({
    'gain': {'setting': 1, 'layout': '<f', 'minimum': 0.0, 'maximum': 10.0},
    'ramp': {'setting': 2, 'layout': '<H'}}),
    'mcu/settings': json.dumps({'filter': {'setting': 1, 'layout': '<I'}}), 'mcu/timeout': 0.4,
    'settings/arduino/gain': START, 'arduino/calibration_timeout': CALIBRATION_TIMEOUT}
_BACK = 1.0             # s
_MOST = 20              # frames with settings in a second
_WINDOW = 1.0           # s
_IN_USE = 'a setting told as confirmed is in use at the board'
_NONE = 'no setting to a board without rows, or while it calibrates'


class _Tunable:
    """Makes the rig's car use settings: `with _Tunable(rig) as car`."""

    def __init__(self, rig: Rig) -> None:
        self._car = rig.car
        self.values = dict(_DEFAULTS)
        self.loses = 0                  # one of so many requests, and of so many answers; 0: none
        self._count = itertools.count(1)

    def __enter__(self) -> '_Tunable':
        self._car.on_packet = self._on_packet
        return self

    def __exit__(self, *_: Any) -> None:
        self._car.on_packet = self._car.packets.append

    def _on_packet(self, packet: Packet) -> None:
        self._car.packets.append(packet)
        number = packet.data[0] if packet.type == codec.SETTING else 0
        if number in _LAYOUTS and not self._is_lost():
            value, = struct.unpack(_LAYOUTS[number], packet.data[1:])
            self.values[number] = min(value, _MOST_USED[number])
            if not self._is_lost():
                self.report(number)

    def _is_lost(self) -> bool:
        return bool(self.loses) and next(self._count) % self.loses == 0

    def report(self, number: int) -> None:
        """Send the value of a setting."""
        self._car.write(codec.arduino_packet(
            codec.SETTING, bytes((number,)) + struct.pack(_LAYOUTS[number], self.values[number])))

    def reset(self) -> None:
        """The board starts again with its defaults, and reports one of them."""
        self.values = dict(_DEFAULTS)
        self.report(1)

    @property
    def text(self) -> str:
        """The values as /diagnostics shows them."""
        return f'gain={self.values[1]:g}, ramp={self.values[2]:g}'


def _service(link: str, persistent: bool = False) -> rospy.ServiceProxy:
    return rospy.ServiceProxy(f'{NODE}/settings/{link}/set_parameters', Reconfigure, persistent)


def _set(link: str = 'arduino', service: Optional[rospy.ServiceProxy] = None,
         **values: float) -> Dict[str, float]:
    """Set these; return what the bridge answers."""
    config = (service or _service(link))(Config(
        doubles=[DoubleParameter(name, value) for name, value in values.items() if name != 'ramp'],
        ints=[IntParameter(name, value) for name, value in values.items() if name == 'ramp'],
    )).config
    return {each.name: each.value for each in (*config.doubles, *config.ints)}


def confirmed(rig: Rig) -> None:
    """The line loses requests and answers."""
    required = rig.row(_IN_USE)
    service = _service('arduino', persistent=True)
    service(Config())       # connects, so that only the bridge's answers are timed
    with _Tunable(rig) as car, contextlib.closing(service):
        for loses, number in itertools.product((0, 3, 2), range(1, 5)):
            car.loses = loses
            began = time.monotonic()
            told = _set(service=service, gain=number / 4, ramp=number * 10 + loses)
            rig.in_time(required, began, time.monotonic(), _ANSWER, 'a set')
            values = rig.next_report('arduino')[2]
            if not values['settings unconfirmed']:
                required.check(values['settings'] == car.text, f"{values['settings']} is told as "
                               f'confirmed, {car.text} is in use')
            required.check(told == {'gain': number / 4, 'ramp': number * 10 + loses}, f'{told}')
            required.wait(lambda: car.values == {1: number / 4, 2: number * 10 + loses}, 'in use')
            rig.in_time(required, began, time.monotonic(), _IN_USE_IN, 'both are in use')
        car.loses = 1
        _set(gain=2.0)
        rig.row('what happened is in the log').wait(lambda: rig.logs.find(
            r'arduino: the board has not confirmed gain = 2.0, it uses 1.0'), 'not confirmed', 10.0)
        required.wait(lambda: 'gain=2' in rig.next_report('arduino')[2]['settings unconfirmed'],
                      'shown as unconfirmed', 10.0)
        car.loses = 0
        required.wait(lambda: car.values[1] == 2.0, 'it is sent again each second', 3.0)
        required.wait(lambda: _set(gain=99.0)['gain'] == _MOST_USED[1], "the board's limit is told")
        required.wait(lambda: rospy.get_param(f'{NODE}/settings/arduino')
                      == {'gain': _MOST_USED[1], 'ramp': 42}, 'the parameters', 10.0)
        required.wait(lambda: _set(gain=1.0, ramp=5000) == {'gain': 1.0, 'ramp': _MOST_USED[2]},
                      "the board's limit is told beside another setting")


def resets(rig: Rig) -> None:
    """The board is reset, also while its port is unplugged, and loses its values."""
    required = rig.row('after a reset all wanted settings are back within 1 s')
    in_use = rig.row(_IN_USE)
    with _Tunable(rig) as car:
        wanted = {1: 7.5, 2: 250}
        _set(gain=7.5, ramp=250)
        for _ in rig.tries(*range(5)):
            began = time.monotonic()
            car.reset()
            required.wait(lambda: car.values == wanted, 'all are back')
            rig.in_time(required, began, time.monotonic(), _BACK, 'all are back')
        for _ in rig.tries(*range(3)):
            rig.car_line.unplug()
            car.values = dict(_DEFAULTS)
            in_use.wait(lambda: rig.next_report('arduino')[2]['settings unconfirmed']
                        == 'gain=7.5, ramp=250', 'none is told as confirmed')
            rig.car_line.plug()
            first = required.wait(lambda: rig.car.beats and rig.car.first, 'the port is opened')
            required.wait(lambda: car.values == wanted, 'all are back')
            rig.in_time(required, first.t, time.monotonic(), _BACK, 'all are back')


def calibrates(rig: Rig) -> None:
    """Nothing is sent to a board that calibrates; afterwards all is."""
    required = rig.row(_NONE)
    with _Tunable(rig) as car:
        _set(gain=1.5)
        for gain in rig.tries(2.5, 3.5):
            rig.car.talks = False
            rig.robot.call('calibrate_imu')
            rig.wait_beats(0.1)
            _set(gain=gain)
            rig.wait_beats(2.2)
            sent = [packet for packet in rig.car.packets if packet.type == codec.SETTING]
            required.check(not sent, f'{sent[:2]} were sent during it')
            rig.car.measure()
            required.wait(lambda gain=gain: car.values[1] == gain, 'it is sent afterwards')
            rig.car.talks = True


def dragged(rig: Rig) -> None:
    """A slider is dragged: each value is set as soon as the one before is answered."""
    limited = rig.row('at most 20 frames with settings in any second')
    in_time = rig.row(STOPS)
    ended = threading.Event()

    def drag() -> None:
        for number in itertools.count():
            _set(gain=number % 100 / 10, ramp=number % 1000)
            if ended.is_set():
                return

    with _Tunable(rig):
        slider = threading.Thread(target=drag)
        slider.start()
        try:
            for speed in range(301, 306):
                rig.robot.command('speed', speed)
                packet = in_time.wait(lambda: rig.car.packet(codec.SPEED, speed), 'the speed')
                check_timeout(rig, packet)
        finally:
            ended.set()
            slider.join()
    times = [packet.t for packet in rig.car.packets if packet.type == codec.SETTING]
    for first, beyond in zip(times, times[_MOST:]):
        rig.in_time(limited, first, beyond, math.inf, f'{_MOST + 1} frames', _WINDOW)


def no_rows(rig: Rig) -> None:
    """A board sends settings that no row describes."""
    required = rig.row(_NONE)
    with _Tunable(rig) as car:
        for number in (1, 2, 1):
            car.report(number)
            rig.wait_beats(0.3)
        sent = [packet for packet in rig.car.packets if packet.type == codec.SETTING]
        required.check(not sent, f'{sent[:2]} were sent')


def starts(rig: Rig) -> None:
    """A value of the parameters is wanted; without one the board's own is shown."""
    required = rig.row('at the start the wanted settings are sent, others are only shown')
    with _Tunable(rig) as car:
        required.wait(lambda: car.values[1] == START, 'the gain of the parameters', 10.0)
        car.report(2)
        required.wait(lambda: rig.next_report('arduino')[2]['settings'] == car.text, car.text,
                      10.0)
        sent = [each.data[0] for each in rig.car.packets if each.type == codec.SETTING]
        required.check(2 not in sent, 'a ramp that nobody wants was sent')


def sensors(rig: Rig) -> None:
    """A setting of the sensor board."""
    required = rig.row(_IN_USE)
    values: List[int] = []

    def received(frame: codec.Frame, now: float) -> None:
        if (frame.type, frame.data[0]) == (codec.SETTING, 1):
            values.append(int.from_bytes(frame.data[1:], 'little'))
            rig.sensors.write(rig.sensors.frame(codec.SETTING, frame.data))
    rig.sensors.received = received
    for value in 3, 258, 3_000_000_000:     # the last one fits in no int32
        told = _set('mcu', filter=value)
        required.check(told == {'filter': value} and values[-1:] == [value], f'{told}, {values}')
        required.wait(lambda: rig.next_report('mcu')[2]['settings'] == f'filter={value}',
                      f'/diagnostics: filter={value}', 10.0)
        required.wait(lambda: rospy.get_param(f'{NODE}/settings/mcu/filter', None) == value,
                      'the parameter', 10.0)
    reported, statuses = rig.row(REPORTED), rig.robot.published['mcu/status']
    ahead = time.time() - time.monotonic()
    rig.sensors.measure()
    last = reported.wait(lambda: rig.robot.values('mcu/status'), 'the status')[-1]
    reported.wait(lambda: statuses[-1] is not last, 'a report')
    rig.in_time(reported, last.wall - ahead, statuses[-1].wall - ahead, 0.7, 'timeout 0.4', 0.35)


def new_master(rig: Rig) -> None:
    """Two settings are set, one by one, and then there is another master."""
    with _Tunable(rig):
        _set(ramp=77)
        _set(gain=3.25)
        rig.row(_IN_USE).wait(lambda: rospy.get_param(f'{NODE}/settings/arduino')
                              == {'gain': 3.25, 'ramp': 77}, 'the parameters', 10.0)
        exact_node.new_master(rig)


SERIAL = starts, sensors, confirmed, resets, calibrates, dragged, new_master
