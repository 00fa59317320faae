"""The link to the model car, over a real tty: what reaches the motor, and when."""
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from fake_boards import PATIENCE, CarBoard, Rfc2217Server, until
from serial_communication.boards.arduino import link as link_module
from serial_communication.boards.arduino import calibration as calibration_module
from serial_communication.boards.arduino import heart as heart_module
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.link.link import OK, WARN, Refused
from serial_communication.transport import pace
from serial_communication.transport.port import Port, PortBusy
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.wire import (Heartbeat, ImuCalibration, LedCommand,
                                                      SpeedCommand, SteeringCommand)
from serial_communication.framing.layout import Value, message_class

STEADY = ArduinoSettings(speed_timeout=0.0)       # a speed holds


@pytest.fixture
def board(line, running):
    return running(CarBoard(line))


@pytest.fixture
def open_link(line, logger, running):
    def start(settings=STEADY, ready=True, port=Port, **arguments):
        link = running(ArduinoLink(port(line.path), settings, logger=logger, **arguments))
        if ready:
            until(lambda: link.heartbeats_sent)
        return link
    return start


def test_commands_reach_the_board_in_order(board, open_link):
    link = open_link()
    link.set_speed(400)
    link.set_steering(1500)
    link.set_led('left')
    link.set_speed(0)
    expected = [SpeedCommand(400), SteeringCommand(1500), LedCommand('left'), SpeedCommand(0)]
    until(lambda: len(board.commands()) >= 4)
    assert board.commands() == expected


@pytest.mark.parametrize('asked, sent', [(1000, 1000), (-1000, -1000), (1001, 1000),
                                         (-1001, -1000), (32767, 1000), (10 ** 9, 1000)])
def test_a_speed_is_saturated_with_a_warning(board, open_link, lines, asked, sent):
    open_link().set_speed(asked)
    until(board.commands)
    assert board.commands() == [SpeedCommand(sent)]
    assert bool(lines(str(asked))) == (asked != sent)


@pytest.mark.parametrize('text', ['x' * 31, 'blinké', 'a\0'])
def test_a_led_text_that_cannot_be_is_refused(board, open_link, text):
    link = open_link()
    with pytest.raises(Refused) as refused:
        link.set_led(text)
    assert 'refused' in str(refused.value)
    link.set_led('x' * 30)
    until(board.commands)
    assert board.commands() == [LedCommand('x' * 30)]


GRIPPER = message_class('gripper', 48, '<hB', [Value('x', scale=0.1, maximum=100), Value('z')])


@pytest.fixture
def own_board(line, running):
    return running(CarBoard(line, [GRIPPER]))


def test_a_command_of_ones_own_keeps_the_rules_of_commands(own_board, open_link):
    link = open_link()
    link.command(GRIPPER(12.5, 9))
    until(own_board.commands)
    assert own_board.commands() == [GRIPPER(12.5, 9)]
    for message, said in ((GRIPPER(100.1, 9), 'gripper refused: x is 100.1, over 100'),
                          (GRIPPER(1.0, 256), 'gripper refused: z is 256, which its place')):
        with pytest.raises(Refused, match=said):
            link.command(message)
    link.calibrate_imu()
    with pytest.raises(Refused, match='gripper x=1 z=2 refused: the IMU is being calibrated'):
        link.command(GRIPPER(1.0, 2))


TEXT = message_class('text', 49, '<s', [Value('data')])


def test_a_command_that_no_board_would_take_for_its_length_is_refused_in_few_words(line, open_link,
                                                                                   running):
    board = running(CarBoard(line, [TEXT]))
    link = open_link()
    for text in ('x' * 256, 'x' * 1000000):
        with pytest.raises(Refused) as refused:
            link.command(TEXT(text))
        assert str(refused.value) == 'text refused: a packet holds at most 255 bytes of data'
    link.command(TEXT('x' * 255))
    until(board.commands)
    assert board.commands() == [TEXT('x' * 255)]


def test_a_led_text_of_any_length_is_refused_in_few_words(board, open_link):
    link = open_link()
    with pytest.raises(Refused) as refused:
        link.set_led('x' * 1000000)
    assert len(str(refused.value)) < 100


def test_a_command_of_ones_own_is_never_kept(own_board, open_link):
    link = open_link()
    with own_board.unplugged():
        until(lambda: not link.port.is_open)
        with pytest.raises(Refused, match='gripper x=1 z=2 refused'):
            link.command(GRIPPER(1.0, 2))
    until(lambda: link.port.is_open)
    link.set_led('left')
    until(own_board.commands)
    assert own_board.commands() == [LedCommand('left')]


def test_measurements_are_passed_on_with_their_stamps(board, line, open_link):
    got = []
    open_link(on_message=lambda message, stamp: got.append((message, stamp)),
              clock=lambda: 'stamp')
    sent = [arduino.Ticks(7), arduino.SteeringAngle(512), arduino.Voltage(14.5),
            arduino.Imu(16384, *[0] * 10)]
    line.write(b''.join(map(arduino.encode, sent)))
    until(lambda: len(got) >= 4)
    assert got == [(message, 'stamp') for message in sent]


@pytest.mark.parametrize('check', [True, False])
def test_implausible_values_are_dropped_if_it_is_set_so(line, board, open_link, check):
    got = []
    link = open_link(STEADY._replace(check_plausibility=check),
                     on_message=lambda message, stamp: got.append(message))
    line.write(arduino.encode(arduino.SteeringAngle(2000)) + arduino.encode(arduino.Ticks(1)))
    until(lambda: arduino.Ticks(1) in got)
    assert (arduino.SteeringAngle(2000) in got) != check
    assert link.decoder.errors['implausible'] == check


def test_the_boards_log_is_passed_on_sparingly(line, board, open_link, lines):
    said = []
    link = open_link(on_log=lambda severity, text: said.append((severity, text)))
    line.write(arduino.encode(arduino.Log(2, 'hot')))
    until(lambda: said)
    assert said == [(2, 'hot')]
    line.write(arduino.encode(arduino.Log(0, 'again')) * 500)
    until(lambda: link.frames_received >= 501)
    assert 50 <= len(said) <= 200
    assert len(lines('logs too much')) == 1


# -- the heartbeat --------------------------------------------------------------------------------

def test_heartbeats_arrive_at_about_their_rate(board, open_link):
    """Over half a second of the board's own clock: never more, and not half as many."""
    link = open_link()
    first = board.heartbeats()
    until(lambda: board.heartbeats() >= first + 60)
    times = [frame.stamp for frame in board.seen if isinstance(frame.message, Heartbeat)]
    rate = (len(times) - 1) / (times[-1] - times[0])
    assert 30 < rate < 115
    assert link.heartbeats_sent >= len(times) and link._heart.max_gap > 0.005


def test_the_heartbeat_rate_is_a_parameter(board, open_link):
    open_link(STEADY._replace(heartbeat_rate=20.0))
    until(lambda: board.heartbeats() >= 8)
    times = [frame.stamp for frame in board.seen if isinstance(frame.message, Heartbeat)]
    assert 5 < (len(times) - 1) / (times[-1] - times[0]) < 25


def test_heartbeats_need_nobody_and_nothing_but_the_port(line, board, open_link):
    """Not a callback that hangs, which holds the thread that reads."""
    hang = threading.Event()
    entered = threading.Event()

    def on_message(message, stamp):
        entered.set()
        hang.wait(PATIENCE)

    open_link(on_message=on_message)
    line.write(arduino.encode(arduino.Ticks(1)))
    assert entered.wait(PATIENCE)
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 30)
    assert not hang.is_set()
    hang.set()


def test_a_command_whose_warning_hangs_holds_no_heartbeat_up(open_link, monkeypatch):
    link = open_link()
    hang = threading.Event()
    monkeypatch.setattr(link.log, 'warn', lambda *_: hang.wait(PATIENCE))
    command = threading.Thread(target=link.set_speed, args=(2000,), name='commands')
    command.start()
    sent = link.heartbeats_sent
    until(lambda: link.heartbeats_sent > sent + 10)
    assert command.is_alive()
    hang.set()
    command.join()


def test_a_warning_of_the_heart_that_hangs_holds_no_heartbeat_up(board, open_link, monkeypatch):
    link = open_link(STEADY._replace(speed_timeout=0.05))
    entered, hang = threading.Event(), threading.Event()
    monkeypatch.setattr(link.log, 'warn', lambda *_: entered.set() or hang.wait(PATIENCE))
    link.set_speed(300)
    until(entered.is_set)
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 30)
    assert board.commands() == [SpeedCommand(300), SpeedCommand(0)] and not hang.is_set()
    hang.set()


def test_after_a_stall_the_heartbeats_missed_do_not_follow_all_at_once(board, open_link):
    class Stalling(Port):
        stalls = False
        written = []

        def write(self, frame):
            if self.stalls:
                self.stalls = False
                time.sleep(0.5)          # fifty periods
                self.written = []
            self.written.append(time.monotonic())
            super().write(frame)

    link = open_link(port=Stalling)
    link.port.stalls = True
    until(lambda: not link.port.stalls)
    before = link.heartbeats_sent
    until(lambda: link.heartbeats_sent > before + 20)
    times = link.port.written
    within = [moment for moment in times if moment < times[0] + 0.05]
    assert len(within) <= 9, 'five periods, and a few for the stall'


# -- the speed timeout ----------------------------------------------------------------------------

def test_speed_0_follows_once_if_no_speed_command_comes(board, open_link, lines):
    link = open_link(ArduinoSettings(speed_timeout=0.1))
    commanded = time.monotonic()    # not when the board has read it, which may be later
    link.set_speed(300)
    until(lambda: SpeedCommand(0) in board.commands())
    speeds = [frame for frame in board.seen if isinstance(frame.message, SpeedCommand)]
    first = [frame.message for frame in speeds].index(SpeedCommand(300))
    assert speeds[first + 1].stamp - commanded >= 0.1
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 30)
    assert board.commands() == [SpeedCommand(300), SpeedCommand(0)]
    until(lambda: lines('SPEED 0 sent'))
    assert len(lines('SPEED 0 sent')) == 1


def test_speed_commands_that_go_on_hold_the_timeout_off(board, open_link):
    link = open_link(ArduinoSettings(speed_timeout=1.0))
    begun = time.monotonic()
    while time.monotonic() < begun + 1.3:
        link.set_speed(200)
        time.sleep(0.02)
    assert set(board.commands()) == {SpeedCommand(200)}
    link.set_speed(0)


def test_without_a_speed_nothing_times_out(board, open_link, lines):
    link = open_link(ArduinoSettings(speed_timeout=0.05))
    link.set_speed(0)
    link.set_steering(1500)
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 25)
    assert board.commands() == [SteeringCommand(1500)] and not lines('no speed command')


def test_a_timeout_of_0_is_never(board, open_link):
    open_link(ArduinoSettings(speed_timeout=0.0)).set_speed(77)
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 80)
    assert board.commands() == [SpeedCommand(77)]


# -- a stop that cannot be lost -------------------------------------------------------------------

def test_a_stop_is_repeated_every_50_ms_for_a_second(board, open_link):
    link = open_link()
    link.set_speed(300)
    link.set_speed(0)
    until(lambda: len(board.commands()) == 2)
    board.forget()
    before = link.heartbeats_sent
    until(lambda: link.heartbeats_sent > before + 130)
    repeated = board.messages(SpeedCommand)
    assert set(repeated) == {SpeedCommand(0)} and 10 <= len(repeated) <= 21
    board.forget()
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 20)
    assert board.messages(SpeedCommand) == [], 'after that no more'


@pytest.mark.parametrize('way', ['commanded', 'timed out'])
def test_a_stop_whose_first_packets_the_line_loses_stops_the_motor(line, open_link, running, way):
    """The board loses the first three SPEED 0 that it is sent after the motion."""
    class Lossy(CarBoard):
        motor = 0
        lost = 0

        def take(self, frame):
            if frame.message == SpeedCommand(0) and self.motor and self.lost < 3:
                self.lost += 1
            elif isinstance(frame.message, SpeedCommand):
                self.motor = frame.message.value

    board = running(Lossy(line))
    link = open_link(ArduinoSettings(speed_timeout=0.2 if way == 'timed out' else 0.0))
    link.set_speed(500)
    until(lambda: board.motor == 500)
    if way == 'commanded':
        link.set_speed(0)
    until(lambda: board.motor == 0)
    assert board.lost == 3


def test_another_speed_ends_the_repetitions(board, open_link):
    link = open_link()
    link.set_speed(300)
    link.set_speed(0)
    link.set_speed(200)
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 30)
    assert board.messages(SpeedCommand)[-1] == SpeedCommand(200)


def test_a_calibration_ends_the_repetitions(board, open_link):
    link = open_link()
    link.set_speed(300)
    link.calibrate_imu()
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 30)
    commands = [message for message in board.messages() if not isinstance(message, Heartbeat)]
    assert commands[-1] == ImuCalibration()


def test_where_the_line_loses_a_calibration_and_the_stop_before_it_the_motor_stops(
        line, open_link, running):
    """The board goes on to read, to drive and to send IMU data."""
    class Lossy(CarBoard):
        motor = 0
        lost = []

        def take(self, frame):
            message = frame.message
            if isinstance(message, ImuCalibration) or (
                    message == SpeedCommand(0) and self.motor and not self.lost):
                self.lost.append(message)
            elif isinstance(message, SpeedCommand):
                self.motor = message.value

    board = running(Lossy(line))
    link = open_link(ArduinoSettings(speed_timeout=0.0))
    link.set_speed(500)
    until(lambda: board.motor == 500)
    board.streaming = True
    link.calibrate_imu()
    until(lambda: board.motor == 0)
    assert board.lost == [SpeedCommand(0), ImuCalibration()]
    board.streaming = False


@pytest.mark.parametrize('way', ['commanded', 'timed out'])
def test_a_speed_0_that_the_bridge_itself_drops_is_followed_by_another(line, open_link, lines, way):
    """The board stops reading; SPEED 0 lies in the kernel, more follows, and all is dropped."""
    decoder = arduino.BoardDecoder()

    def heard():
        return [frame.message for frame in decoder.feed(line.read(0.1), 0.0) if not frame.cause]

    def more(number):
        for _ in range(number):
            try:
                link.set_led('x' * 30)
            except Refused:
                return

    link = open_link(ArduinoSettings(speed_timeout=0.2 if way == 'timed out' else 0.0))
    link.set_speed(500)
    until(lambda: SpeedCommand(500) in heard())
    more(300)         # so that SPEED 0 is not the first in the kernel, which a flush may leave
    if way == 'commanded':
        link.set_speed(0)
    else:
        until(lambda: lines('SPEED 0 sent'))
    sent = link.heartbeats_sent
    until(lambda: link.heartbeats_sent > sent + 130, what='the end of its repetitions')
    until(lambda: more(100) or lines('what waited was dropped'))
    until(lambda: SpeedCommand(0) in heard())


def test_a_speed_that_cannot_be_shown_to_a_listener_times_out_all_the_same(board, open_link):
    def fail(*_):
        raise OSError('no room')

    link = open_link(ArduinoSettings(speed_timeout=0.2))
    link.tap = fail
    link.set_speed(500)
    until(lambda: board.commands() == [SpeedCommand(500), SpeedCommand(0)])
    before = board.heartbeats()
    until(lambda: board.heartbeats() > before + 20)


def test_no_heartbeat_leaves_while_speed_0_cannot(line, open_link):
    """After output was dropped, and the kernel takes nothing: what leaves first is SPEED 0."""
    class Choosy(Port):
        refuses = b''
        written = []

        def write(self, frame):
            if self.refuses and self.refuses in frame:
                raise PortBusy('the port takes no data')
            super().write(frame)
            self.written.append(frame)

    link = open_link(port=Choosy)
    link.set_speed(500)
    link.port.refuses = arduino.encode(SpeedCommand(0))
    with link._sending:
        link._unblock()
        link.port.written = []
    with pytest.raises(Refused):
        link.set_speed(400)
    threading.Event().wait(0.2)
    assert link.port.written == []
    link.port.refuses = b''
    until(lambda: len(link.port.written) > 3)
    assert link.port.written[0].endswith(arduino.encode(SpeedCommand(0)))


# -- a standstill ---------------------------------------------------------------------------------

@pytest.fixture
def standstill(monkeypatch):
    """All the link's threads wake from one, as far as its clock can tell."""
    def stand_still(link, seconds):
        with link._sending:
            skipped[0] += seconds
            del link.port.written[:]

    skipped = [0.0]
    real = heart_module.clock
    for module in (pace, heart_module, link_module):
        monkeypatch.setattr(module, 'clock', lambda: real() + skipped[0])
    return stand_still


class Noted(Port):
    """Keeps what it was given to write."""

    def __init__(self, path):
        super().__init__(path)
        self.written = []

    def write(self, frame):
        super().write(frame)
        self.written.append(frame)


def test_after_a_standstill_speed_0_is_first_whoever_wakes_first(board, open_link, standstill,
                                                                 lines):
    link = open_link(ArduinoSettings(speed_timeout=0.5), port=Noted)
    link.set_speed(500)
    for _ in range(10):       # sometimes the heart wakes first, sometimes a command
        standstill(link, 5.0)
        with pytest.raises(Refused) as refused:
            link.set_speed(300)
        assert 'stood still' in str(refused.value)
        until(lambda: len(link.port.written) > 3)
        assert link.port.written[0] == arduino.encode(SpeedCommand(0))
    assert SpeedCommand(300) not in board.messages()
    until(lambda: lines('the bridge stood still for'))


def takes_speed(link, value):
    """Whether it is sent; False where it is refused."""
    try:
        link.set_speed(value)
        return True
    except Refused:
        return False


def test_nothing_commanded_during_a_standstill_is_sent_and_what_comes_later_is(
        board, open_link, standstill):
    link = open_link(ArduinoSettings(speed_timeout=0.5), port=Noted)
    standstill(link, 5.0)
    for command in (lambda: link.set_speed(1), lambda: link.set_steering(1),
                    lambda: link.set_led('left'), link.calibrate_imu):
        with pytest.raises(Refused):
            command()
    assert not link.calibrating

    until(lambda: takes_speed(link, 2))
    until(board.commands)
    assert board.commands()[0] == SpeedCommand(2)


def test_a_standstill_while_the_port_is_closed_counts(board, open_link, standstill):
    link = open_link(ArduinoSettings(speed_timeout=0.5), port=Noted)
    with board.unplugged():
        until(lambda: not link.port.is_open)
        standstill(link, 5.0)
        with pytest.raises(Refused) as refused:
            link.set_speed(1)
        assert refused.value.cause == 'stall'


STOPPED = ("import logging, sys\n"
           "from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings\n"
           "from serial_communication.link.link import Refused\n"
           "from serial_communication.transport.port import Port\n"
           "settings = ArduinoSettings(speed_timeout=float(sys.argv[2]))\n"
           "link = ArduinoLink(Port(sys.argv[1]), settings)\n"
           "link.start()\n"
           "for command in sys.stdin:\n"
           "    try:\n"
           "        if command.strip() == 'calibrate':\n"
           "            link.calibrate_imu()\n"
           "        else:\n"
           "            link.set_speed(int(command))\n"
           "    except Refused as refused:\n"
           "        print(refused, flush=True)\n"
           "link.stop()\n"
           "link.join()\n")


def test_where_only_receiving_stalls_the_heart_goes_on_and_the_car_stands(
        board, line, open_link, lines):
    entered, free = threading.Event(), threading.Event()

    def on_message(_message, _stamp):
        entered.set()
        free.wait(PATIENCE)

    link = open_link(on_message=on_message)
    link.set_speed(500)
    until(lambda: board.commands() == [SpeedCommand(500)])
    line.write(arduino.encode(arduino.Ticks(1)))
    until(entered.is_set)
    until(lambda: board.commands() == [SpeedCommand(500), SpeedCommand(0)])
    beats = board.heartbeats()
    until(lambda: board.heartbeats() > beats + 150)     # as long as a stop is repeated, and longer
    assert len(board.messages(SpeedCommand)) <= 30, 'a SPEED 0 with every heartbeat'
    for command in (lambda: link.set_speed(1), lambda: link.set_steering(1500)):
        with pytest.raises(Refused) as refused:
            command()
        assert refused.value.cause == 'stall'
    free.set()
    with pytest.raises(Refused):
        link.set_speed(1)       # it may have waited as long

    until(lambda: takes_speed(link, 2))
    until(lambda: board.commands()[-1] == SpeedCommand(2))
    assert SpeedCommand(1) not in board.messages()
    until(lambda: lines('the bridge stood still for'))


_PINNED = """\
import logging, os, sys
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.link.link import Refused
from serial_communication.transport.pace import set_priority_of_all
from serial_communication.transport.port import Port
os.sched_setaffinity(0, {int(sys.argv[2])})
link = ArduinoLink(Port(sys.argv[1]), ArduinoSettings(speed_timeout=0.0))
set_priority_of_all(1)     # as the node does; the heart then takes more
link.start()
for command in sys.stdin:
    try:
        link.set_speed(int(command))
        print('accepted', flush=True)
    except Refused as refused:
        print('refused', refused.cause, flush=True)
link.stop()
"""
_HOG = """\
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
print('begun', flush=True)
end = time.monotonic() + 1.5
while time.monotonic() < end:
    pass
"""


@pytest.fixture
def a_core():
    """One that this test keeps away from."""
    cores = os.sched_getaffinity(0)
    if len(cores) < 2:
        pytest.skip('there is one core only')
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except PermissionError:
        pytest.skip('this user may not take real-time priority')
    os.sched_setaffinity(0, cores - {max(cores)})
    yield str(max(cores))
    os.sched_setaffinity(0, cores)


def test_a_hog_that_keeps_the_bridge_from_receiving_lets_no_old_command_drive(
        board, line, a_core):
    """Its priority is between that of the heart and that of the threads that receive."""
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}
    bridge = subprocess.Popen([sys.executable, '-c', _PINNED, line.path, a_core],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                              universal_newlines=True, env=environment, bufsize=1)

    def command(speed):
        bridge.stdin.write(f'{speed}\n')

    try:
        until(board.heartbeats)
        until(lambda: command(500) or bridge.stdout.readline() == 'accepted\n')
        until(lambda: SpeedCommand(500) in board.messages())
        board.forget()
        hog = subprocess.Popen([sys.executable, '-c', _HOG, a_core], stdout=subprocess.PIPE)
        assert hog.stdout.readline() == b'begun\n'
        command(300)
        assert hog.wait() == 0
        hog.stdout.close()
        assert bridge.stdout.readline() == 'refused stall\n'
        until(lambda: command(200) or bridge.stdout.readline() == 'accepted\n')
        until(lambda: SpeedCommand(200) in board.messages())
        assert board.commands() == [SpeedCommand(0), SpeedCommand(200)]
    finally:
        bridge.communicate()


@pytest.mark.parametrize('speed_timeout', ['0.5', '0'])
def test_a_process_that_was_stopped_says_speed_0_first_and_none_of_what_waited(
        board, line, speed_timeout):
    """SIGSTOP and SIGCONT; ten commands wait in a pipe for a thread of that process."""
    bridge = subprocess.Popen([sys.executable, '-c', STOPPED, line.path, speed_timeout],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                              universal_newlines=True)
    try:
        def drive():
            bridge.stdin.write('500\n')
            bridge.stdin.flush()
            return board.commands()[-1:] == [SpeedCommand(500)]

        until(lambda: board.heartbeats() > 3)
        # The signal may come between the decision to send a heartbeat and its write: that one
        # then leaves first, which nothing in the process can exclude, and SPEED 0 is next.
        for _ in range(3):
            until(drive, every=0.05)
            bridge.send_signal(signal.SIGSTOP)
            os.waitpid(bridge.pid, os.WUNTRACED)
            threading.Event().wait(1.0)
            board.forget()
            bridge.stdin.write('321\n' * 10)
            bridge.stdin.flush()
            bridge.send_signal(signal.SIGCONT)
            until(lambda: '321' in bridge.stdout.readline())
            until(lambda: board.heartbeats() > 20)
            assert SpeedCommand(321) not in board.messages()
            assert SpeedCommand(0) in board.messages()[:2]
            if board.messages()[0] == SpeedCommand(0):
                break
        assert board.messages()[0] == SpeedCommand(0)
    finally:
        bridge.kill()
        bridge.communicate()


# -- the port goes and comes ----------------------------------------------------------------------

def test_commands_to_a_closed_port_are_refused_and_not_kept(board, open_link):
    link = open_link()
    with board.unplugged():
        until(lambda: not link.port.is_open)
        for command in (lambda: link.set_speed(500), lambda: link.set_steering(1),
                        lambda: link.set_led('left'), link.calibrate_imu):
            with pytest.raises(Refused) as refused:
                command()
            assert 'closed' in str(refused.value)
        assert not link.calibrating
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 20)
    assert board.commands() == [] and link.reconnects == 1


@pytest.mark.parametrize('speed', [500, 0])
def test_after_a_reconnect_speed_0_is_first_and_repeated(board, open_link, speed):
    link = open_link()
    link.set_speed(speed)
    link.set_steering(1234)
    until(lambda: SteeringCommand(1234) in board.commands())
    with board.unplugged():
        until(lambda: not link.port.is_open)
        board.forget()
    until(lambda: len(board.messages(SpeedCommand)) >= 10)
    assert board.messages()[0] == SpeedCommand(0), 'before any heartbeat'
    assert set(board.messages(SpeedCommand)) == {SpeedCommand(0)}


def test_a_command_between_the_opening_and_the_first_heartbeat_comes_after_speed_0(line, logger):
    """As the port has opened, and before the link's threads have done anything with it."""
    link = ArduinoLink(Port(line.path), STEADY, logger=logger)
    link.port.open()
    link.set_speed(500)
    assert line.read_all() == arduino.encode(SpeedCommand(0)) + arduino.encode(SpeedCommand(500))
    link.port.close()


def test_the_first_opening_begins_with_speed_0(board, open_link):
    """The board may hold the speed of a bridge that crashed."""
    open_link()
    until(lambda: board.heartbeats() >= 3)
    assert board.messages()[0] == SpeedCommand(0)


def test_the_time_while_the_port_is_closed_is_no_heartbeat_gap(board, open_link, standstill):
    link = open_link(port=Noted)
    with board.unplugged():
        until(lambda: not link.port.is_open)
        standstill(link, 1000.0)
    sent = link.heartbeats_sent
    until(lambda: link.heartbeats_sent > sent + 3)
    assert link._heart.max_gap < 1000.0


def test_a_heartbeat_gap_is_a_warning_until_a_report_without_one(board, open_link):
    def is_ok():
        level, summary, _ = link.report(time.monotonic())
        return level == OK and summary == 'open'

    link = open_link()
    board.streaming = True
    until(is_ok)
    with link._sending:         # so that no heartbeat can leave
        sent = link.heartbeats_sent
        assert not threading.Event().wait(0.1)
        level, summary, values = link.report(time.monotonic())
        assert level == WARN
        assert re.match('heartbeat gap of [0-9.]+ ms: after 30 ms the board stops its motor; '
                        'see .* in doc/troubleshooting.md$', summary)
        assert float(dict(values)['heartbeat gap [ms]']) > 90.0
    until(lambda: link.heartbeats_sent > sent + 1)
    report = link.report(time.monotonic())
    assert report.level == WARN and report.summary.startswith('heartbeat gap of ')
    until(is_ok)
    assert float(dict(link.report(time.monotonic()).values)['heartbeat max gap [ms]']) > 90.0
    board.streaming = False


def test_no_heartbeat_is_counted_while_the_port_is_closed(board, open_link):
    link = open_link()
    with board.unplugged():
        until(lambda: not link.port.is_open)
        sent = link.heartbeats_sent
        assert not threading.Event().wait(0.1)
        assert link.heartbeats_sent == sent


# -- over a network -------------------------------------------------------------------------------

@pytest.fixture
def network(logger, running):
    """A link over a connection, and the server's end of it."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        server.settimeout(PATIENCE)

        def connect(network_silence, window=0):
            if window:
                server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window)
            link = running(ArduinoLink(
                Port('socket://127.0.0.1:%d' % server.getsockname()[1]),
                STEADY._replace(network_silence=network_silence), logger=logger))
            link.peer, _ = server.accept()
            until(lambda: link.heartbeats_sent)
            link.accept = lambda: server.accept()[0]
            return link

        yield connect


def messages(data):
    return [frame.message for frame in arduino.BoardDecoder().feed(data, 0.0) if not frame.cause]


def read_to_the_end(peer):
    """All that comes until the connection has been ended or reset."""
    data = b''
    peer.settimeout(PATIENCE)
    try:
        part = b'x'
        while part:
            part = peer.recv(1 << 20)
            data += part
    except ConnectionResetError:
        pass
    return data


def test_a_board_not_heard_over_a_network_gets_a_new_connection_and_no_old_speed(network, lines):
    """The peer stands still: it neither speaks nor reads, and commands go on."""
    link = network(0.4)
    begun = time.monotonic()
    while link.reconnects == 0:
        assert time.monotonic() < begun + PATIENCE
        try:
            link.set_speed(500)
        except Refused:
            pass
        time.sleep(0.02)
    assert lines('the board has not been heard for 0.4 s')
    with link.accept() as peer:
        peer.settimeout(PATIENCE)
        assert messages(peer.recv(1 << 16))[0] == SpeedCommand(0)
    # What the peer's kernel has is out of reach; it ends with a stop.
    with link.peer as old:
        speeds = [message for message in messages(read_to_the_end(old))
                  if isinstance(message, SpeedCommand)]
    assert len(speeds) > 1 and speeds[-1] == SpeedCommand(0)


def limit_silence(link, seconds):
    """From now on: a slow machine may have needed any time to come so far."""
    link.settings = link.settings._replace(network_silence=seconds)
    link.wake()


def test_a_board_that_calibrates_may_be_silent_over_a_network(network):
    link = network(0.0)
    link.peer.sendall(arduino.encode(arduino.Ticks(1)))
    link.calibrate_imu()
    limit_silence(link, 0.3)
    sent = link.heartbeats_sent
    until(lambda: link.heartbeats_sent > sent + 80)
    assert link.calibrating and link.reconnects == 0
    link.peer.close()


def test_a_connection_that_takes_no_data_is_broken_off_and_its_data_not_sent_later(network, lines):
    # So that nothing but the stall ends it, and the peer's kernel has no room for the rest.
    link = network(0.0, window=1)
    peer = link.peer
    begun = time.monotonic()
    while link.reconnects == 0:
        assert time.monotonic() < begun + PATIENCE
        try:
            link.set_led('x' * 30)
        except Refused:
            time.sleep(0.005)
    assert lines('the connection is broken off') and not lines('was dropped')
    sent = link.port.bytes_sent
    with link.accept() as new:
        new.settimeout(PATIENCE)
        assert messages(new.recv(1 << 16))[0] == SpeedCommand(0)
    with peer:
        assert len(read_to_the_end(peer)) < sent


def test_an_rfc2217_server_that_stands_still_delivers_no_drive_afterwards(line, logger, running):
    """It takes commands until the link gives it up; they end with a stop."""
    with socket.create_server(('127.0.0.1', 0)) as listening:
        listening.settimeout(PATIENCE)
        server = Rfc2217Server(listening, line.path)
        board = running(CarBoard(line))
        link = running(ArduinoLink(Port(server.url), STEADY._replace(network_silence=0.0),
                                   logger=logger))
        board.streaming = True
        until(lambda: link.heartbeats_sent and link.last_frame_at)
        link.set_speed(500)
        until(board.commands)
        board.streaming = False
        server.stand_still()
        limit_silence(link, 0.4)
        begun = time.monotonic()
        slowest = 0.0
        while link.port.is_open:
            assert time.monotonic() < begun + PATIENCE
            before = time.monotonic()
            try:
                link.set_speed(400)
            except Refused:
                pass
            slowest = max(slowest, time.monotonic() - before)
            time.sleep(0.02)
        assert slowest < 1.0, 'a command waited for the network'
        server.go_on()
        until(lambda: not server.alive)
    # What follows on the same tty comes behind all that the connection had delivered.
    with open(line.path, 'wb', buffering=0) as behind:
        behind.write(b'\0' + arduino.encode(LedCommand('brake')))
    until(lambda: LedCommand('brake') in board.commands())
    assert board.commands()[-2:] == [SpeedCommand(0), LedCommand('brake')]


# -- calibration ----------------------------------------------------------------------------------

def test_a_calibration_stops_the_car_and_refuses_commands_until_imu_data_returns(
        board, line, open_link, monkeypatch):
    monkeypatch.setattr(calibration_module, '_SILENCE', 0.3)
    changes, got = [], []
    link = open_link(on_calibrating=changes.append,
                     on_message=lambda message, stamp: got.append(message))
    link.set_speed(300)
    begun = time.monotonic()
    link.calibrate_imu()
    until(lambda: len(board.commands()) >= 3)
    assert board.commands() == [SpeedCommand(300), SpeedCommand(0), ImuCalibration()]
    assert link.calibrating and changes == [True]
    for command in (lambda: link.set_speed(500), lambda: link.set_speed(0),
                    lambda: link.set_steering(1), lambda: link.set_led('left'),
                    link.calibrate_imu):
        with pytest.raises(Refused) as refused:
            command()
        assert 'calibrat' in str(refused.value)
    line.write(arduino.encode(arduino.Ticks(1)) + arduino.encode(arduino.Voltage(12.0)))
    until(lambda: len(got) >= 2)
    assert link.calibrating, 'only IMU data ends it'
    until(lambda: not link.calibrating, doing=lambda: line.write(CarBoard.IMU), every=0.4)
    assert time.monotonic() - begun >= 0.3
    until(lambda: changes == [True, False])
    link.set_speed(5)
    until(lambda: board.commands()[-1] == SpeedCommand(5))
    assert len(board.commands()) == 4


def test_imu_data_that_was_under_way_as_a_calibration_began_does_not_end_it(
        board, line, open_link, lines):
    """As over a network that takes 0.6 s each way: data goes on for 1.2 s."""
    link = open_link()
    board.streaming = True
    until(lambda: link.last_frame_at)
    link.calibrate_imu()
    threading.Event().wait(1.2)
    board.streaming = False
    with pytest.raises(Refused, match='the IMU is being calibrated'):
        link.set_speed(500)

    def say_after_a_silence():
        if time.monotonic() > said[0] + 2.1:
            said[0] = time.monotonic()
            line.write(CarBoard.IMU)

    said = [time.monotonic()]
    until(lambda: not link.calibrating, doing=say_after_a_silence)
    assert not lines('does not calibrate')
    link.set_speed(5)
    until(lambda: board.commands()[-1:] == [SpeedCommand(5)])
    assert SpeedCommand(500) not in board.messages()


def test_a_board_that_does_not_calibrate_gets_commands_again(
        board, open_link, lines, monkeypatch):
    """Its IMU data goes on: the request was lost on the line, say."""
    monkeypatch.setattr(calibration_module, '_GOES_ON', 0.5)
    link = open_link()
    board.streaming = True
    link.calibrate_imu()
    until(lambda: not link.calibrating)
    assert lines('IMU data has gone on for 5 s since the calibration was asked for')
    until(lambda: takes_speed(link, 5))
    until(lambda: board.commands()[-1:] == [SpeedCommand(5)])
    board.streaming = False


def test_a_board_that_was_reset_by_a_reconnect_calibrates_no_more(
        board, open_link, monkeypatch):
    monkeypatch.setattr(calibration_module, '_GOES_ON', 0.5)
    link = open_link()
    link.calibrate_imu()
    with board.unplugged():
        until(lambda: not link.port.is_open)
    until(lambda: link.port.is_open and link.reconnects)
    board.streaming = True
    until(lambda: not link.calibrating)
    board.streaming = False


def test_the_time_of_a_stall_is_no_silence_that_ends_a_calibration(board, line):
    """SIGSTOP as the calibration has begun; IMU data that was under way waits in the port."""
    bridge = subprocess.Popen([sys.executable, '-c', STOPPED, line.path, '0.5'],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                              universal_newlines=True)

    def ask(command):
        bridge.stdin.write(command + '\n')
        bridge.stdin.flush()

    try:
        until(lambda: board.heartbeats() > 3)
        ask('calibrate')
        until(lambda: board.messages(ImuCalibration))
        bridge.send_signal(signal.SIGSTOP)
        os.waitpid(bridge.pid, os.WUNTRACED)
        line.write(CarBoard.IMU * 20)
        threading.Event().wait(2.5)
        bridge.send_signal(signal.SIGCONT)
        # As it wakes, every command is refused for half a second anyway.
        before = board.heartbeats()
        until(lambda: board.heartbeats() > before + 70)
        ask('321')
        ask('calibrate')
        assert 'speed 321 refused: the IMU is being calibrated' in bridge.stdout.readline()
    finally:
        bridge.kill()
        bridge.communicate()


def test_heartbeats_go_on_during_a_calibration(board, open_link):
    link = open_link()
    link.calibrate_imu()
    before = board.heartbeats()
    until(lambda: board.heartbeats() >= before + 20)
    assert link.calibrating


def test_a_calibration_without_an_end_is_over_after_its_timeout(board, open_link):
    changes = []
    link = open_link(STEADY._replace(calibration_timeout=0.1), on_calibrating=changes.append)
    link.calibrate_imu()
    until(lambda: changes == [True, False], 'the end of the calibration', seconds=4.0)
    link.set_speed(1)


def test_a_calibration_lasts_through_a_reconnect(board, open_link):
    link = open_link()
    link.calibrate_imu()
    with board.unplugged():
        until(lambda: not link.port.is_open)
    until(lambda: link.port.is_open and link.reconnects)
    with pytest.raises(Refused):
        link.set_speed(100)


# -- the end --------------------------------------------------------------------------------------

def stop_and_listen(link, board):
    link.stop()
    link.join()
    assert not link.port.is_open
    quiet = threading.Event()
    quiet.wait(0.1)


def test_stopping_sends_speed_0_last_and_then_nothing(board, open_link):
    link = open_link()
    link.set_speed(300)
    until(board.commands)
    stop_and_listen(link, board)
    assert board.messages()[-1] == SpeedCommand(0)
    with pytest.raises(Refused):
        link.set_speed(300)


def test_stopping_sends_speed_0_also_while_the_board_talks(board, open_link):
    """The reading thread wakes often then: it must not close the port before the last word."""
    link = open_link()
    board.streaming = True
    link.set_speed(300)
    until(board.commands)
    until(lambda: link.frames_received > 3)
    stopping = threading.Thread(target=link.stop, name='stopping', daemon=True)
    with link._sending:               # as if a command were just on its way
        stopping.start()
        threading.Event().wait(0.15)  # some thirty packets
    stopping.join(PATIENCE)
    stop_and_listen(link, board)
    board.streaming = False
    assert board.messages()[-1] == SpeedCommand(0), 'the last word was not SPEED 0'


def test_stopping_lets_speed_0_leave_before_the_port_closes(line, board, open_link):
    """As on a UART, whose buffer takes its time to empty and is lost by closing."""
    class SlowPort(Port):
        empty_at = 0.0
        left_at_close = None

        def write(self, frame):
            super().write(frame)
            if arduino.encode(SpeedCommand(0)) in frame:
                self.empty_at = time.monotonic() + 0.03

        def on_its_way(self):
            return time.monotonic() < self.empty_at

        def close(self):
            if self.is_open and self.left_at_close is None:
                self.left_at_close = self.on_its_way()
            super().close()

    link = open_link(port=SlowPort)
    link.set_speed(300)
    stop_and_listen(link, board)
    assert link.port.left_at_close is False


def test_stopping_ends_soon_while_the_board_does_not_read(line, open_link):
    link = open_link()
    link.set_speed(300)
    begun = time.monotonic()
    link.stop()
    link.join()
    assert time.monotonic() - begun < 1.5
    assert not link.port.is_open


def test_a_link_that_never_opened_stops(line, logger):
    link = ArduinoLink(Port(line.path + '.absent'), STEADY, logger=logger)
    link.start()
    link.stop()
    link.join()
