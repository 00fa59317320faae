"""What happens to a robot, drawn by a seed: boards, lines, programs that use them, and faults."""
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

from adapter import Robot, parts_of, read_functions
from device import Damage, Device
from simulated import ControlBoard, ModelCar, SensorBoard, line_of, write_announcement
from world import World

KINDS = 'tty', 'tty', 'pty', 'network'
ROWS = {
    'force': {'type': 32, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data'],
              'scale': 0.01},
    'gripper': {'type': 33, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt16',
                'layout': '<H', 'fields': ['data']},
    # A motion: its zero stops it.
    'drive': {'type': 34, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist',
              'layout': '<hh', 'fields': ['linear.x', 'angular.z'], 'scale': 0.001,
              'minimum': -2.0, 'maximum': 2.0},
    'kp': {'setting': 1, 'layout': '<f', 'minimum': 0.0, 'maximum': 10.0},
    'limit': {'setting': 2, 'layout': '<H', 'minimum': 0, 'maximum': 500}}
FUNCTIONS = {
    'halt': {'cmd2': 0x2F, 'srv_type': 'std_srvs/Trigger', 'repeatable': True, 'interrupts': True},
    'press': {'cmd2': 0x30, 'srv_type': 'std_srvs/Trigger',
              'request': {'layout': '<H', 'fields': ['n']}},
    'level': {'cmd2': 0x31, 'srv_type': 'std_srvs/Trigger', 'repeatable': True,
              'request': {'layout': '<H', 'fields': ['n']},
              'reply': {'layout': '<H', 'fields': ['level']}}}
# Of another board behind the same port.
OTHER_FUNCTIONS = {name: FUNCTIONS[name] for name in ('halt', 'level')}


class Command(NamedTuple):
    """A command of a program, and the bridge's answer at once."""

    time: float
    name: str
    value: Any
    refused: str        # the cause; '': it was accepted


class Told(NamedTuple):
    """What a caller was told."""

    word: str       # `done`, `not sent`, `refused`: by INVALID, `failed`: by ERROR, `not known` …
    data: bytes
    text: str


class Called:
    """A call of a program."""

    def __init__(self, time: float, name: str, request: Tuple[int, int, bytes]) -> None:
        self.time, self.name, self.request = time, name, request
        self.repeatable, self.longest = False, 0.0
        self.told: Optional[Told] = None        # to its caller
        self.ended: Optional[float] = None      # when


class Event(NamedTuple):
    """A fault, or something that people did; `end` is when it is over."""

    begin: float
    end: float
    name: str
    value: Any = None


class FarEnd:
    """The board at the other end of a line, in virtual time."""

    def __init__(self, world: World, device: Device, board: Any, damage: Damage,
                 drift: Optional[int]) -> None:
        self._drift = drift
        self.notes: List[Tuple[float, str, dict]] = []
        self._world, self._device = world, device
        device.receive = self._received
        device.damage_received = damage
        device.on_pulse = lambda: self.reset(0.3)
        self.put(board)

    def put(self, board: Any) -> None:
        """Connect this board, which starts now."""
        self.board = board
        self.line = line_of(board, self._device.from_board,
                            lambda *note: self.notes.append(note), self._drift)
        self.line.start(self._world.time)
        self._due = float('inf')
        self._tick()

    def reset(self, seconds: float) -> None:
        self.line.begin('reset', seconds, self._world.time)
        self._tick()

    def silence(self, seconds: float) -> None:
        self.line.begin('silence', seconds, self._world.time)

    def _received(self, data: bytes) -> None:
        self.line.receive(data, self._world.time)
        self._tick()

    def _tick(self, due: Optional[float] = None) -> None:
        if due is not None and due != self._due:
            return
        wanted = self.line.tick(self._world.time)
        self._due = float('inf') if wanted is None else max(wanted, self._world.time + 1e-6)
        if wanted is not None:
            line, at = self.line, self._due
            self._world.at(at, lambda: self._tick(at) if line is self.line else None)


class Story:
    """One link of a robot and what happens to it.

    Args:
        kind: arduino, bus or mcu.
        hertz: how often the board sends.
        calm: without faults of any kind.
    """

    def __init__(self, world: World, kind: str, hertz: float = 10.0, calm: bool = False) -> None:
        self.world, self.kind = world, kind
        self.random = world.random
        self.events: List[Event] = []
        self.boards: List[Tuple[float, List[str]]] = []     # since when, and their rows
        self.commands: List[Command] = []
        self.calls: List[Called] = []
        self.reports: List[Tuple[float, Dict[str, Any]]] = []
        self.wants: List[Tuple[float, str, float]] = []
        self.tasks: List[Tuple[float, float, str, Any]] = []     # asked, lent until, what, its task
        self.stopped_at: List[float] = []       # by ~stop
        self.ended: Optional[float] = None
        self._number = 0
        self._hertz = hertz
        self.announces = self.random.random() < (0.3 if kind == 'bus' else 0.5)
        self.device = Device(world, self.random.choice(KINDS), 115200)
        damage = Damage() if calm or self.random.random() < 0.4 else Damage(
            *(self.random.choice((0.0, 0.002, 0.02)) for _ in range(3)))
        self.device.split = self.random.choice((0.0, 0.3, 0.9))
        self.device.hold = self.random.choice((0.0, 0.0, 0.001, 0.016))
        self.echoes = self.random.random() < 0.85        # the board of the bus knows ECHO
        # ppm; the board sends its time.
        self.drift = self.random.choice((None, None, 50, -300, 4000)) if kind != 'bus' else None
        self.far = FarEnd(world, self.device, self.new_board(), damage, self.drift)
        if not calm and kind != 'mcu' and self.random.random() < 0.5:
            self.device.damage_sent = Damage(*(
                self.random.choice((0.0, 0.01, 0.05) if kind == 'bus' else (0.0, 0.002, 0.01))
                for _ in range(3)))
        rows = {} if self.announces else self._rows()
        parameters: Dict[str, Any] = {}
        if kind == 'bus':
            parameters = {'environment_period': self.random.choice((0.0, 0.06, 0.3, 1.0)),
                          'echo': self.random.random() < (0.95 if self.echoes else 0.4),
                          'announcements': self.announces}
        else:
            parameters = {'network_silence': self.random.choice((5.0, 1.5, 1.5))}
        if kind == 'arduino':
            parameters['calibration_timeout'] = self.random.choice((900.0, 900.0, 4.0))
        self.parameters = parameters
        self.robot = Robot(world, self.device, kind, rows, self.random.random() < 0.5, **parameters)
        # Of each report what the line and the taps had by then.
        self.counted: List[Tuple[float, Dict[str, Any], int, int, int, int]] = []

    def look(self) -> None:
        """Ask for a report."""
        now, report, device = self.world.clock(), self.robot.report(), self.device
        self.reports.append((now, report))
        self.counted.append((now, report, len(device.bridge_read), len(device.bridge_wrote),
                             len(self.robot.tapped), len(self.robot.published)))

    def new_board(self, rows: Optional[Dict[str, Any]] = None) -> Any:
        rows = rows or self._rows()
        self.boards.append((self.world.time, list(rows)))
        text = write_announcement(rows, 'judged 1') if self.announces else None
        seed = self.random.randrange(2 ** 31)
        if self.kind == 'bus':
            return ControlBoard(lift_speed=self.random.choice((100.0, 1000.0)), gimbal_speed=900.0,
                                seed=seed, echoes=self.echoes, custom=read_functions(rows),
                                announcement=text)
        custom, settings = parts_of(rows)
        own = {'custom': custom, 'settings': settings, 'announcement': text, 'seed': seed}
        if self.kind == 'mcu':
            return SensorBoard(self._hertz, **own)
        # One that calibrates for no time sends on; less than 2 s is no calibration.
        return ModelCar(self.random.choice((8.0, *(
            self.random.uniform(1.0, most) for most in (2.2, 3.5)), 0.001)), **own,
                        period=1 / self._hertz)

    def _rows(self) -> Dict[str, Any]:
        """Of the board at first: the sensors' reads settings alone."""
        return FUNCTIONS if self.kind == 'bus' else ROWS if self.kind == 'arduino' else {
            name: row for name, row in ROWS.items() if row.get('direction') != 'to_board'}

    # -- what happens ---------------------------------------------------------------------------

    def happen(self, name: str, seconds: float, value: Any = None) -> None:
        """Note an event that lasts for so long."""
        now = self.world.clock()
        self.events.append(Event(now, now + seconds, name, value))

    def every(self, low: float, high: float, action: Callable[[], None]) -> None:
        """Do something again and again, with pauses of so many seconds."""
        def again() -> None:
            if self.ended is None:
                action()
                self.world.after(self.random.uniform(low, high), again)
        self.world.after(self.random.uniform(0.0, high), again)

    def number(self) -> int:
        """A number that nothing else in this story has."""
        self._number += 1
        return self._number

    def end(self) -> None:
        """The bridge ends."""
        self.ended = self.world.clock()
        self.robot.end()
