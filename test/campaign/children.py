"""The processes that use the bridge during a campaign: callers, a commander, subscribers.

    python3 -m campaign.children ROLE FILE SEED [N]

They end at SIGTERM or SIGINT, with all they know in their file. The commander takes orders on
stdin: ``calibrate``.
"""
import os
import random
import signal
import sys
import threading
import time
from typing import Callable, Dict, Iterator, List, Tuple

import rospy
from std_msgs.msg import String, UInt16
from std_srvs.srv import Empty, Trigger

from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.srv import BusRequest, GetEnvironment, Gimbal, Lift

from serial_communication.boards.bus import wire as bus
from serial_communication.tools.watch.topics import NODE, SERIAL_MSG, resolve
from .expected import RECORDED
from .packets import PRESS
from .records import Lines, MessageFile

TRAFFIC = resolve(SERIAL_MSG, NODE)
MEMORY = 0xF0          # CMD2 that the simulated board executes and no bridge knows
UNSUPPORTED = 0x77     # CMD2 that it refuses
PATIENCE = 6.0         # s that a call may take before it counts as lost
_START = 30.0          # s for the bridge to offer its services
_APART = 0.1             # s from one caller's first call to the next one's
_LAST_CALLS = 4.0      # s for the calls under way as the callers end
STEADY = 400             # the speed of a car that just drives
METRONOME_PRIORITY = 10  # real-time, as the simulated boards have it: the least of all
_SPEEDS = [value for value in range(-1000, 1001) if value]

stopping = threading.Event()


def main() -> int:
    """Play the role that the command line names."""
    role, path, seed = sys.argv[1], sys.argv[2], sys.argv[3]
    for number in signal.SIGTERM, signal.SIGINT:
        signal.signal(number, lambda *_: stopping.set())
    if role == 'metronome':
        return beat(path)
    rospy.init_node('soak_' + role, anonymous=True, disable_signals=True,
                    disable_rosout=True)
    ROLES[role](path, random.Random(f'{role} {seed}'))
    # Not through rospy's own end, which may wait for a bridge that is gone.
    sys.stdout.flush()
    os._exit(0)


# -- callers --------------------------------------------------------------------------------


def moves(randomly: random.Random, directions: int) -> Iterator[Tuple[int, int]]:
    """Direction and amount, no pair again within half of all pairs: so each move that the board
    executes tells whose it was."""
    halves = [[(d, amount) for d in range(directions) for amount in range(half, 256, 2)]
              for half in (0, 1)]
    while True:
        for half in halves:
            randomly.shuffle(half)
            yield from half


class Locked:
    """An iterator for several threads."""

    def __init__(self, iterator: Iterator) -> None:
        self._iterator = iterator
        self._lock = threading.Lock()

    def __next__(self):
        with self._lock:
            return next(self._iterator)


class Caller(threading.Thread):
    """Calls one service after the other, each with a pause of up to `pause` seconds."""

    def __init__(self, lines: Lines, name: str, service: str, service_class,
                 arguments: Callable[[], Dict], persistent: bool, randomly: random.Random,
                 pause: float) -> None:
        super().__init__(name=name, daemon=True)
        self.kind = name
        self.under_way: Dict = {}
        self._lines = lines
        self.service = NODE + service
        self._class = service_class
        self._arguments = arguments
        self._persistent = persistent
        self._random = randomly
        self._pause = pause

    def run(self) -> None:
        proxy = None
        while not stopping.is_set():
            record, request = self._arguments()
            record.update(kind=self.kind, t0=time.monotonic())
            self.under_way = record
            try:
                if proxy is None:
                    proxy = rospy.ServiceProxy(self.service, self._class, self._persistent)
                record['t0'] = time.monotonic()
                answer = proxy(**request)
                record['t1'] = time.monotonic()
                record.update(_told(answer))
            except Exception as error:  # pylint: disable=broad-except
                record['t1'] = time.monotonic()
                record['exception'] = f'{type(error).__name__}: {error}'
                proxy = None
            self.under_way = {}
            self._lines.write(**record)
            stopping.wait(self._random.random() * self._pause)


def _told(answer) -> Dict:
    told = {'success': answer.success, 'message': answer.message}
    if hasattr(answer, 'status'):
        told.update(status=answer.status, error=answer.error_code)
    if hasattr(answer, 'data'):
        told['reply'] = bytes(answer.data).hex()
    return told


def call(path: str, randomly: random.Random) -> None:
    """Lift, gimbal, raw requests and a function of one's own, all at once."""
    lines = Lines(path)
    lifts, gimbals = Locked(moves(randomly, 2)), Locked(moves(randomly, 4))
    presses = Locked(moves(randomly, 256))
    numbers = Locked(iter(range(1 << 40)))
    callers = []
    for index in range(2):
        own = random.Random(randomly.random())
        callers += [
            Caller(lines, 'lift', '/lift', Lift, lambda own=own: _lift(lifts, own), bool(index),
                   own, 0.15),
            Caller(lines, 'gimbal', '/gimbal', Gimbal, lambda own=own: _gimbal(gimbals, own),
                   bool(index), own, 0.15),
            Caller(lines, 'raw', '/bus/request', BusRequest,
                   lambda own=own: _raw(numbers, own), bool(index), own, 0.1),
            Caller(lines, 'own', '/press', Lift, lambda: _press(presses), bool(index), own, 0.3)]
    own = random.Random(randomly.random())
    callers += [
        Caller(lines, 'environment', '/get_environment', GetEnvironment, lambda: ({}, {}), True,
               own, 3.0),
        Caller(lines, 'echo', '/bus/echo', Trigger, lambda: ({}, {}), True, own, 3.0)]
    for caller in callers:
        rospy.wait_for_service(caller.service, _START)
    for caller in callers:
        caller.start()
        # rospy's listener keeps five connections waiting; TCP asks again for a sixth after 1 s.
        stopping.wait(_APART)
    stopping.wait()
    deadline = time.monotonic() + _LAST_CALLS
    for caller in callers:
        caller.join(max(0.0, deadline - time.monotonic()))
        record = caller.under_way
        if record:
            lines.write(t1=None, **{key: value for key, value in record.items() if key != 't1'})
    lines.close()


def _lift(lifts: Locked, randomly: random.Random) -> Tuple[Dict, Dict]:
    direction, amount = next(lifts)
    if randomly.random() < 0.03:
        direction = randomly.randrange(2, 256)     # the bridge refuses this
    return _move(bus.LIFT, direction, amount, dict(direction=direction, distance=amount))


def _gimbal(gimbals: Locked, randomly: random.Random) -> Tuple[Dict, Dict]:
    direction, amount = next(gimbals)
    if randomly.random() < 0.03:
        direction = randomly.randrange(4, 256)
    return _move(bus.GIMBAL, direction, amount, dict(direction=direction, angle=amount))


def _press(presses: Locked) -> Tuple[Dict, Dict]:
    direction, amount = next(presses)
    return _move(PRESS, direction, amount, dict(direction=direction, distance=amount))


def _move(cmd2: int, direction: int, amount: int, request: Dict) -> Tuple[Dict, Dict]:
    return ({'cmd1': bus.FUNCTION, 'cmd2': cmd2, 'data': bytes((direction, amount)).hex()},
            request)


def _raw(numbers: Locked, randomly: random.Random) -> Tuple[Dict, Dict]:
    """Data that nobody else has: a running number, and padding of any length."""
    cmd1, cmd2 = bus.FUNCTION, MEMORY
    chance = randomly.random()
    if chance < 0.15:
        cmd1, cmd2 = bus.ECHO, 0
    elif chance < 0.3:
        cmd2 = UNSUPPORTED
    elif chance < 0.33:
        cmd1 = 0x0C     # reserved: refused
    size = randomly.choice((8, 8, 9, 16, 40, 255, 300) if randomly.random() < 0.97
                           else (bus.MAX_LENGTH, bus.MAX_LENGTH + 1))
    data = next(numbers).to_bytes(6, 'little') + bytes(
        randomly.randrange(256) for _ in range(min(size, 40) - 6))
    data += bytes(size - len(data))
    return ({'cmd1': cmd1, 'cmd2': cmd2, 'data': data.hex()},
            dict(cmd1=cmd1, cmd2=cmd2, data=data))


# -- the commander --------------------------------------------------------------------------


def command(path: str, randomly: random.Random) -> None:
    """Speeds with pauses, steering, LEDs; calibrations when told on stdin."""
    lines = Lines(path)
    loops = [_drive, _steer, _light, _wind]
    threads = [threading.Thread(target=loop, args=(lines, random.Random(randomly.random())),
                                daemon=True) for loop in loops]
    threads.append(threading.Thread(target=_orders, args=(lines,), daemon=True))
    for thread in threads:
        thread.start()
    stopping.wait()
    for thread in threads[:-1]:
        thread.join(2.0)
    lines.close()


def _publisher(name: str, message_class) -> rospy.Publisher:
    return rospy.Publisher(NODE + name, message_class, queue_size=10, tcp_nodelay=True)


def _drive(lines: Lines, randomly: random.Random) -> None:
    """Each speed once in a hundred seconds, so that one seen late is known for what it is."""
    topic = _publisher('/speed', SpeedPWMCommand)

    def publish(value: int) -> None:
        lines.write(t=time.monotonic(), topic='speed', value=value)
        topic.publish(value=value)

    speeds = _shuffled(_SPEEDS, randomly)
    while not stopping.is_set():
        end = time.monotonic() + randomly.uniform(0.05, 2.5)
        pace = randomly.uniform(0.03, 0.3)
        while time.monotonic() < end and not stopping.is_set():
            value = next(speeds)
            if randomly.random() < 0.02:
                value = randomly.choice((-1, 1)) * randomly.randrange(1001, 32768)
            publish(value)
            stopping.wait(pace)
        if randomly.random() < 0.2:
            publish(0)
        stopping.wait(randomly.uniform(0.7, 1.5))


def _shuffled(values: List[int], randomly: random.Random) -> Iterator[int]:
    values = randomly.sample(values, len(values))
    half = len(values) // 2
    parts = [values[:half], values[half:]]
    while True:
        for part in parts:
            randomly.shuffle(part)
            yield from part


def _steer(lines: Lines, randomly: random.Random) -> None:
    topic = _publisher('/steering', SteeringPWMCommand)
    value = 0
    while not stopping.wait(randomly.uniform(0.02, 0.2)):
        value = (value + 7919) % 65536
        lines.write(t=time.monotonic(), topic='steering', value=value)
        topic.publish(value=value)


def _light(lines: Lines, randomly: random.Random) -> None:
    topic = _publisher('/led', String)
    texts = ('left', 'right', 'brake', 'hazard', 'disable', 'x' * 30, 'x' * 31, 'mañana', '')
    while not stopping.wait(randomly.uniform(0.2, 2.0)):
        text = randomly.choice(texts)
        lines.write(t=time.monotonic(), topic='led', value=text)
        topic.publish(data=text)


def _wind(lines: Lines, randomly: random.Random) -> None:
    """A command of one's own, each value once in an hour; 0 is none that its row allows."""
    topic = _publisher('/winch', UInt16)
    value = randomly.randrange(1 << 16)
    while not stopping.wait(randomly.uniform(0.02, 0.2)):
        value = (value + 1) % (1 << 16)
        lines.write(t=time.monotonic(), topic='winch', value=value)
        topic.publish(data=value)


def _orders(lines: Lines) -> None:
    for line in sys.stdin:
        if line.strip() != 'calibrate':
            continue
        began = time.monotonic()
        try:
            rospy.ServiceProxy(NODE + '/calibrate_imu', Empty)()
            error = ''
        except rospy.ServiceException as trouble:
            error = str(trouble)
        lines.write(topic='calibrate', t0=began, t1=time.monotonic(), error=error)


def drive(path: str, _random: random.Random) -> None:
    """One speed, without a pause; a lift call for each ``lift`` on stdin."""
    lines = Lines(path)
    threading.Thread(target=_lift_orders, args=(lines,), daemon=True).start()
    topic = _publisher('/speed', SpeedPWMCommand)
    while not stopping.wait(0.02):
        topic.publish(value=STEADY)
    lines.close()


def _lift_orders(lines: Lines) -> None:
    for line in sys.stdin:
        if line.strip() == 'lift':
            threading.Thread(target=_lift_once, args=(lines,), daemon=True).start()


def _lift_once(lines: Lines) -> None:
    began = time.monotonic()
    try:
        answer = rospy.ServiceProxy(NODE + '/lift', Lift)(0, 255)
        lines.write(t0=began, t1=time.monotonic(), status=answer.status)
    except (rospy.ServiceException, rospy.ROSException) as error:
        lines.write(t0=began, t1=time.monotonic(), error=str(error))


# -- subscribers ----------------------------------------------------------------------------


def record(path: str, _random: random.Random) -> None:
    """Every topic but serial_msg, as it was serialized."""
    _record(path, list(RECORDED))


def record_traffic(path: str, _random: random.Random) -> None:
    """serial_msg."""
    _record(path, [TRAFFIC])


def _record(path: str, topics: List[str]) -> None:
    file = MessageFile(path, topics)
    for topic in topics:
        rospy.Subscriber(topic, rospy.AnyMsg, _take, (file, topic), tcp_nodelay=True,
                         buff_size=1 << 20)
    while not stopping.wait(0.5):
        file.flush()
    file.close()


def _take(message: rospy.AnyMsg, file_and_topic: Tuple[MessageFile, str]) -> None:
    file, topic = file_and_topic
    file.write(topic, message._buff)  # pylint: disable=protected-access


def sleep(_path: str, _random: random.Random) -> None:
    """Subscribes to everything; to be stopped and continued from outside."""
    for topic in [*RECORDED, TRAFFIC]:
        rospy.Subscriber(topic, rospy.AnyMsg, lambda message: None)
    stopping.wait()


# -- a witness ------------------------------------------------------------------------------


def beat(path: str) -> int:
    """Wakes every 10 ms, at a board's priority, and writes down when the machine was late."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(METRONOME_PRIORITY))
    except OSError:
        pass
    lines = Lines(path)
    due = time.monotonic()
    while not stopping.is_set():
        due = max(due + 0.01, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
        late = time.monotonic() - due
        if late > 0.005:
            lines.write(t=due, late=round(late, 4))
    lines.close()
    return 0


ROLES = {'callers': call, 'driver': drive, 'commander': command, 'recorder': record,
         'traffic': record_traffic, 'sleeper': sleep}

if __name__ == '__main__':
    sys.exit(main())
