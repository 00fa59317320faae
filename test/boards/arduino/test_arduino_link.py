"""The link to the model car over a real tty: what reaches the motor, and when."""
import os
import re
import signal
import socket
import subprocess
import threading
import time
from unittest import mock

import pytest

from fake_boards import PATIENCE, CarBoard, until
from lines import Pty
from waiting import again_if_stalled
from serial_communication.boards.arduino import link as link_module
from serial_communication.boards.arduino import output as output_module
from serial_communication.boards.arduino import calibration as calibration_module
from serial_communication.boards.arduino import heartbeat as heartbeat_module
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.link.link import OK, WARN, Refused
from serial_communication.transport import pace
from serial_communication.transport.port import Port, PortBusy
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.wire import (Heartbeat, ImuCalibration, LedCommand,
                                                      SpeedCommand, SteeringCommand)
from serial_communication.framing.layout import Value, message_class

STEADY = ArduinoSettings(speed_timeout=0.0)       # no speed times out
STOP = arduino.encode(SpeedCommand(0))


def more_heartbeats(of, number):
    """Wait for so many heartbeats: that the board receives, or that the link sends."""
    def count():
        return of.heartbeats() if isinstance(of, CarBoard) else of.heartbeats_sent

    before = count()
    until(lambda: count() >= before + number)


def refusal(command, *arguments):
    """What the command raises if it is refused; None if it is sent."""
    try:
        command(*arguments)
    except Refused as refused:
        return refused
    return None


def commands_of(link):
    """One call of each command."""
    return (lambda: link.set_speed(500), lambda: link.set_steering(1),
            lambda: link.set_led('left'), link.calibrate_imu)


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


@pytest.mark.parametrize('text', ['x' * 31, 'blinké', 'a\0', 'x' * 1000000])
def test_an_invalid_led_text_is_refused_with_a_short_text(board, open_link, text):
    link = open_link()
    refused = str(refusal(link.set_led, text))
    assert 'refused' in refused and len(refused) < 100
    link.set_led('x' * 30)
    until(board.commands)
    assert board.commands() == [LedCommand('x' * 30)]


GRIPPER = message_class('gripper', 48, '<hB', [Value('x', scale=0.1, maximum=100), Value('z')])


@pytest.fixture
def custom_board(line, running):
    return running(CarBoard(line, [GRIPPER]))


def test_a_custom_command_is_refused_like_other_commands(custom_board, open_link):
    link = open_link()
    link.command(GRIPPER(12.5, 9))
    until(custom_board.commands)
    assert custom_board.commands() == [GRIPPER(12.5, 9)]
    for message, said in ((GRIPPER(100.1, 9), 'gripper refused: x is 100.1, above the maxi'),
                          (GRIPPER(1.0, 256), 'gripper refused: z is 256, which its place')):
        assert str(refusal(link.command, message)).startswith(said)
    link.calibrate_imu()
    assert str(refusal(link.command, GRIPPER(1.0, 2))).startswith(
        'gripper x=1 z=2 refused: the board calibrates its IMU')


TEXT = message_class('text', 49, '<s', [Value('data')])


def test_a_command_that_is_too_long_is_refused_with_a_short_text(line, open_link, running):
    board = running(CarBoard(line, [TEXT]))
    link = open_link()
    for text in ('x' * 256, 'x' * 1000000):
        assert str(refusal(link.command, TEXT(text))) == (
            f'text refused: {len(text)} bytes of data, a packet holds at most 255')
    link.command(TEXT('x' * 255))
    until(board.commands)
    assert board.commands() == [TEXT('x' * 255)]


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
def test_implausible_values_are_dropped_only_if_checked(line, board, open_link, check):
    got = []
    link = open_link(STEADY._replace(check_plausibility=check),
                     on_message=lambda message, stamp: got.append(message))
    line.write(arduino.encode(arduino.SteeringAngle(2000)) + arduino.encode(arduino.Ticks(1)))
    until(lambda: arduino.Ticks(1) in got)
    assert (arduino.SteeringAngle(2000) in got) != check
    assert link.decoder.errors['implausible'] == check


def test_log_messages_are_passed_on_at_a_limited_rate(line, board, open_link, lines):
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

@pytest.mark.parametrize('wanted, number', [(100.0, 60), (20.0, 8)])
def test_heartbeats_arrive_at_about_their_rate(board, open_link, wanted, number):
    """By the board's clock: hardly more than the rate, and at least 0.3 times it."""
    link = open_link(STEADY._replace(heartbeat_rate=wanted))

    def rate():
        first = board.heartbeats()
        until(lambda: board.heartbeats() >= first + number)
        times = [frame.stamp for frame in list(board.frames)
                 if isinstance(frame.message, Heartbeat)][first:]
        return (len(times) - 1) / max(times[-1] - times[0], 1e-6)
    # If this machine stalls the board as it begins to count, the rest comes faster, or at once.
    assert any(0.3 * wanted < rate() < 1.15 * wanted for _ in range(5))
    assert link.heartbeats_sent >= board.heartbeats() and link.heartbeat.max_gap > 0.005


def test_heartbeats_go_on_while_a_callback_blocks(line, board, open_link):
    """The callback blocks the thread that reads."""
    hang = threading.Event()
    entered = threading.Event()

    def on_message(message, stamp):
        entered.set()
        hang.wait(PATIENCE)

    open_link(on_message=on_message)
    line.write(arduino.encode(arduino.Ticks(1)))
    assert entered.wait(PATIENCE)
    more_heartbeats(board, 30)
    assert not hang.is_set()
    hang.set()


class RecordingPort(Port):
    """Keeps the frames that were written."""

    def __init__(self, path):
        super().__init__(path)
        self.written = []

    def write(self, frame):
        super().write(frame)
        self.written.append(frame)


@pytest.fixture
def threadless(line, logger):
    """A link whose port is open. None of its threads runs: the test does their work."""
    link = ArduinoLink(RecordingPort(line.path), STEADY, logger=logger)
    link.port.open()
    yield link
    link.port.close()


def read_what_was_sent(line, link, before=b''):
    """The bytes at the other end, `before` included, when all that the port took are there."""
    data = bytearray(before)
    until(lambda: len(data) >= link.port.bytes_sent, doing=lambda: data.extend(line.read(0.05)))
    return bytes(data)


# -- the speed timeout ----------------------------------------------------------------------------

def test_speed_0_is_sent_if_no_speed_command_follows(board, open_link, lines):
    link = open_link(ArduinoSettings(speed_timeout=0.1))
    commanded = time.monotonic()    # not when the board has read it, which may be later
    link.set_speed(300)
    until(lambda: SpeedCommand(0) in board.commands())
    speeds = [frame for frame in board.frames if isinstance(frame.message, SpeedCommand)]
    first = [frame.message for frame in speeds].index(SpeedCommand(300))
    assert speeds[first + 1].stamp - commanded >= 0.1
    more_heartbeats(board, 30)
    assert board.commands() == [SpeedCommand(300), SpeedCommand(0)]
    until(lambda: lines('sent SPEED 0'))
    assert len(lines('sent SPEED 0')) == 1


# -- repetitions of a stop -------------------------------------------------------------------

class LossyBoard(CarBoard):
    """A car whose line loses requests to calibrate, and so many SPEED 0 while the motor turns."""

    def __init__(self, line, stops):
        self.motor, self.lost, self._stops = 0, [], stops
        super().__init__(line)

    def take(self, frame):
        message = frame.message
        if isinstance(message, ImuCalibration) or (
                message == SpeedCommand(0) and self.motor and len(self.lost) < self._stops):
            self.lost.append(message)
        elif isinstance(message, SpeedCommand):
            self.motor = message.value


def test_the_motor_stops_though_the_line_loses_the_first_stops(line, open_link, running):
    """The line loses the first three SPEED 0 after the motion."""
    board = running(LossyBoard(line, 3))
    link = open_link()

    def stops():
        board.lost.clear()
        link.set_speed(500)
        until(lambda: board.motor == 500)
        link.set_speed(0)
        more_heartbeats(board, 110)     # longer than a stop is repeated
        return board.motor == 0 and board.lost == [SpeedCommand(0)] * 3
    again_if_stalled(stops)


def test_a_calibration_ends_the_repetitions_of_a_stop(board, open_link):
    link = open_link()
    link.set_speed(300)
    link.calibrate_imu()
    more_heartbeats(board, 30)
    commands = [message for message in board.messages() if not isinstance(message, Heartbeat)]
    assert commands[-1] == ImuCalibration()


def test_the_motor_stops_though_the_line_loses_a_calibration_and_its_stop(
        line, open_link, running):
    """The board keeps reading, driving and sending IMU data."""
    board = running(LossyBoard(line, 1))
    link = open_link(ArduinoSettings(speed_timeout=0.0))
    link.set_speed(500)
    until(lambda: board.motor == 500)
    board.streaming = True
    link.calibrate_imu()
    until(lambda: board.motor == 0)
    assert board.lost == [SpeedCommand(0), ImuCalibration()]
    board.streaming = False


def test_speed_0_is_sent_again_after_the_bridge_dropped_its_output(line, open_link, lines):
    """The board stops reading. SPEED 0 waits in the kernel with more data, and all is dropped."""
    decoder = arduino.BoardDecoder()

    def received():
        return [frame.message for frame in decoder.feed(line.read(0.1), 0.0) if not frame.cause]

    def more(number):
        any(refusal(link.set_led, 'x' * 30) for _ in range(number))

    link = open_link()
    link.set_speed(500)
    until(lambda: SpeedCommand(500) in received())
    more(300)         # a flush may leave the first packet: this must not be SPEED 0
    link.set_speed(0)
    more_heartbeats(link, 130)
    until(lambda: more(100) or lines('the output that waited is dropped'))
    until(lambda: SpeedCommand(0) in received())


def test_no_heartbeat_is_sent_before_a_pending_speed_0(line, open_link):
    """Output was dropped and the port refuses SPEED 0: nothing else may be sent before it."""
    class Selective(RecordingPort):
        refuses = b''

        def write(self, frame):
            if self.refuses and self.refuses in frame:
                raise PortBusy('the port takes no data')
            super().write(frame)

    link = open_link(port=Selective)
    link.set_speed(500)
    link.port.refuses = arduino.encode(SpeedCommand(0))
    with link.output.lock:
        link.output._drop_backlog()
        link.port.written = []
    assert refusal(link.set_speed, 400)
    threading.Event().wait(0.2)
    assert link.port.written == []
    link.port.refuses = b''
    until(lambda: len(link.port.written) > 3)
    assert link.port.written[0].endswith(arduino.encode(SpeedCommand(0)))


@pytest.mark.parametrize('method, busy', [
    ('backlog', {'return_value': 0.06}), ('write', {'side_effect': PortBusy('it is full')})],
    ids=['backlog', 'write'])
def test_a_speed_0_that_a_busy_port_refuses_is_the_next_packet(threadless, method, busy):
    """The port takes data again before the heartbeat thread can see that it was busy."""
    link = threadless
    link.set_speed(300)
    with mock.patch.object(link.port, method, **busy):
        if method == 'backlog':     # and it was written just now
            link.output._line.wrote(2000, pace.clock())
        assert refusal(link.set_speed, 0).cause == 'busy'
    link.port.written.clear()
    link.output.send_what_is_due(True)
    assert link.port.written[0] == STOP


# -- stalls ---------------------------------------------------------------------------------

@pytest.fixture
def stall(monkeypatch):
    """Move the link's clock forward, as if all its threads had stalled."""
    def stall_link(link, seconds):
        with link.output.lock:
            skipped[0] += seconds
            del link.port.written[:]

    stall_link.skipped = skipped = [0.0]
    real = heartbeat_module.clock
    for module in (pace, heartbeat_module, link_module, output_module):
        monkeypatch.setattr(module, 'clock', lambda: real() + skipped[0])
    return stall_link


@pytest.mark.stalls
def test_after_a_stall_speed_0_is_sent_first_whichever_thread_runs(
        board, open_link, stall, lines):
    link = open_link(ArduinoSettings(speed_timeout=0.5), port=RecordingPort)
    until(lambda: not refusal(link.set_speed, 500))
    for _ in range(10):       # either thread may run first: the heartbeat's or the caller's
        stall(link, 5.0)
        assert 'the bridge stalled' in str(refusal(link.set_speed, 300))
        until(lambda: len(link.port.written) > 3)
        assert link.port.written[0] == arduino.encode(SpeedCommand(0))
    assert SpeedCommand(300) not in board.messages()
    until(lambda: lines(' s: SPEED 0 is sent first'))


CLAW = message_class('claw', 50, '<?', [Value('data')])
FIRE = message_class('fire', 51, '<')
# Messages are tuples: the first two are equal to SPEED 0, the third one to a heartbeat.
ALIKE = SteeringCommand(0), CLAW(False), FIRE()


@pytest.mark.stalls
@pytest.mark.parametrize('command', [SpeedCommand(300), *ALIKE, ImuCalibration()], ids=str)
def test_a_command_whose_thread_stalls_just_before_it_is_written_is_not_sent(
        board, open_link, stall, monkeypatch, command):
    link = open_link(STEADY, port=RecordingPort)

    def backlog(whole=link.port.backlog):     # the last that is asked before a command is written
        if threading.current_thread() is threading.main_thread():
            stall.skipped[0] += 15.0
            link.port.written.clear()
        return whole()

    monkeypatch.setattr(link.port, 'backlog', backlog)

    def reaches_the_write():
        before = stall.skipped[0]
        refused = refusal(link.command, command)
        assert 'it may have waited while the bridge stalled' in str(refused)
        return stall.skipped[0] > before

    until(reaches_the_write)
    until(lambda: len(link.port.written) > 3)
    assert link.port.written[0] == STOP
    assert arduino.encode(command) not in link.port.written and not link.calibrating


def test_after_a_stall_just_before_a_heartbeat_speed_0_is_sent_first(
        threadless, stall, monkeypatch):
    link = threadless
    link.set_speed(300)

    def backlog():      # asked after the look at the clock, before the heartbeat is written
        stall.skipped[0] += 2e9
        return 0.0

    monkeypatch.setattr(link.port, 'backlog', backlog)
    link.port.written.clear()
    link.output.send_what_is_due(True)
    assert link.port.written == [STOP, arduino.encode(Heartbeat())]


@pytest.mark.stalls
def test_commands_are_refused_just_after_a_stall_and_accepted_later(board, open_link, stall):
    link = open_link(ArduinoSettings(speed_timeout=0.5), port=RecordingPort)
    stall(link, 5.0)
    assert all(map(refusal, commands_of(link)))
    assert not link.calibrating

    until(lambda: not refusal(link.set_speed, 2))
    until(board.commands)
    assert board.commands()[0] == SpeedCommand(2)


@pytest.mark.stalls
def test_a_call_to_calibrate_is_refused_after_a_stall_of_over_300_ms(board, open_link, stall):
    """A topic's command only after one of over 500 ms."""
    link = open_link(port=RecordingPort)

    def refuses_only_that():
        stall(link, 0.4)
        assert 'it may have waited while the bridge stalled' in str(refusal(link.calibrate_imu))
        return not refusal(link.set_speed, 1)

    again_if_stalled(refuses_only_that)

    def calibrates():
        refused = refusal(link.calibrate_imu)
        assert not refused or refused.cause == 'stall'
        return link.calibrating

    until(calibrates)


@pytest.mark.stalls
def test_a_stall_is_no_silence_that_ends_a_calibration(line, board, open_link, stall):
    got = []
    link = open_link(port=RecordingPort, on_message=lambda message, stamp: got.append(message))
    until(lambda: not refusal(link.calibrate_imu))
    stall(link, 10.0)
    until(lambda: got or line.write(CarBoard.IMU), every=0.05)
    assert link.calibrating


@pytest.mark.stalls
def test_if_only_receiving_stalls_heartbeats_go_on_and_the_motor_stops(
        board, line, open_link, lines):
    entered, free = threading.Event(), threading.Event()

    def on_message(_message, _stamp):
        entered.set()
        free.wait(PATIENCE)

    def drives():       # this machine may stall, too
        refusal(link.set_speed, 500)
        return board.speeds[-1:] == [500]

    link = open_link(STEADY._replace(network_silence=0.0), on_message=on_message)
    until(drives, every=0.05)
    until(entered.is_set, doing=lambda: line.write(arduino.encode(arduino.Ticks(1))), every=0.05)
    until(lambda: board.speeds[-1:] == [0])
    until(lambda: set(map(type, board.messages()[-60:])) == {Heartbeat},
          'no SPEED 0 with every heartbeat')
    assert {refusal(command).cause for command in commands_of(link)} == {'stall'}
    free.set()
    assert refusal(link.set_speed, 1), 'it may have waited during the stall'

    until(lambda: board.speeds[-1:] == [2], doing=lambda: refusal(link.set_speed, 2), every=0.05)
    assert SpeedCommand(1) not in board.messages()
    until(lambda: lines(' s: SPEED 0 is sent first'))


# -- reconnects ----------------------------------------------------------------------

def test_commands_to_a_closed_port_are_refused_and_not_sent_later(board, open_link):
    link = open_link()
    with board.unplugged():
        until(lambda: not link.port.is_open)
        assert all('closed' in str(refusal(command)) for command in commands_of(link))
        assert not link.calibrating
    more_heartbeats(board, 20)
    assert board.commands() == [] and link.connection.reconnects == 1


@pytest.mark.parametrize('speed', [500, 0])
def test_after_a_reconnect_speed_0_is_first_and_repeated(board, open_link, speed):
    link = open_link()
    link.set_speed(speed)
    link.set_steering(1234)
    until(lambda: SteeringCommand(1234) in board.commands())

    def repeats_it():
        with board.unplugged():
            until(lambda: not link.port.is_open)
            board.forget()
        more_heartbeats(board, 110)     # longer than a stop is repeated
        assert board.messages()[0] == SpeedCommand(0), 'before any heartbeat'
        assert set(board.messages(SpeedCommand)) == {SpeedCommand(0)}
        return len(board.messages(SpeedCommand)) >= 10
    again_if_stalled(repeats_it)


@pytest.mark.parametrize('command', [SpeedCommand(500), *ALIKE], ids=str)
def test_a_command_just_after_the_opening_follows_speed_0(threadless, line, command):
    """The port is open, and no thread of the link has used it yet."""
    threadless.command(command)
    assert read_what_was_sent(line, threadless) == STOP + arduino.encode(command)


def test_a_packet_that_closing_has_cut_does_not_spoil_the_first_speed_0(threadless, line):
    link = threadless
    link.set_speed(300)
    send = link.port._opened.send
    with mock.patch.object(link.port._opened, 'send', lambda data: send(data[:3])):
        link.set_steering(1234)
    cut = read_what_was_sent(line, link)
    link.connection._close()
    link.port.open()
    link.output.send_what_is_due(True)
    assert messages(read_what_was_sent(line, link, cut)) == [
        SpeedCommand(0), SpeedCommand(300), SpeedCommand(0), Heartbeat()]


def test_a_heartbeat_gap_is_a_warning_until_a_report_without_a_gap(
        board, open_link, monkeypatch):
    # A board that this machine stalls is not silent.
    monkeypatch.setattr('serial_communication.link.link.SILENCE', PATIENCE)

    def is_ok():
        level, summary, _ = link.report(time.monotonic())
        return level == OK and summary == 'open'

    link = open_link()
    board.streaming = True
    until(is_ok)
    with link.output.lock:         # so that no heartbeat can be sent
        sent = link.heartbeats_sent
        assert not threading.Event().wait(0.1)
        level, summary, values = link.report(time.monotonic())
        assert level == WARN
        assert re.match('heartbeat gap of [0-9.]+ ms: after 30 ms the board stops its motor; '
                        'see .* in doc/troubleshooting.md$', summary)
        assert float(dict(values)['heartbeat gap [ms]']) >= 100.0
    until(lambda: link.heartbeats_sent > sent + 1)
    report = link.report(time.monotonic())
    assert report.level == WARN and report.summary.startswith('heartbeat gap of ')
    until(is_ok)
    assert float(dict(link.report(time.monotonic()).values)['heartbeat max gap [ms]']) >= 100.0
    board.streaming = False


# -- over a network -------------------------------------------------------------------------------

@pytest.fixture
def network(logger, running):
    """A function that connects a link to a server; link.peer is the server's end."""
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


def read_until_closed(peer):
    """All data until the connection is closed or reset."""
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


def test_a_silent_network_port_is_opened_anew_and_delivers_no_old_speed(network, lines):
    """The peer neither sends nor reads, while commands go on."""
    link = network(0.4)
    begun = time.monotonic()
    while link.connection.reconnects == 0:
        assert time.monotonic() < begun + PATIENCE
        refusal(link.set_speed, 500)
        time.sleep(0.02)
    assert lines('nothing received from the board for 0.4 s')
    with link.accept() as peer:
        peer.settimeout(PATIENCE)
        assert messages(peer.recv(1 << 16))[0] == SpeedCommand(0)
    # The data in the peer's kernel is out of reach; it has to end with a stop.
    with link.peer as old:
        speeds = [message for message in messages(read_until_closed(old))
                  if isinstance(message, SpeedCommand)]
    assert len(speeds) > 1 and speeds[-1] == SpeedCommand(0)


def limit_silence(link, seconds):
    """Set it only now: on a slow machine, getting here may take any time."""
    link.settings = link.settings._replace(network_silence=seconds)
    link.wake()


def test_a_network_port_is_not_opened_anew_during_a_calibration(network):
    link = network(0.0)
    link.peer.sendall(arduino.encode(arduino.Ticks(1)))
    link.calibrate_imu()
    limit_silence(link, 0.3)
    more_heartbeats(link, 80)
    assert link.calibrating and link.connection.reconnects == 0
    link.peer.close()


def test_a_blocked_connection_is_closed_and_its_data_not_sent_later(network, lines):
    # No silence limit, and a small buffer: only the blocked output can close the connection.
    link = network(0.0, window=1)
    peer = link.peer
    begun = time.monotonic()
    while link.connection.reconnects == 0:
        assert time.monotonic() < begun + PATIENCE
        if refusal(link.set_led, 'x' * 30):
            time.sleep(0.005)
    assert lines('the connection is closed') and not lines('is dropped')
    sent = link.port.bytes_sent
    with link.accept() as new:
        new.settimeout(PATIENCE)
        assert messages(new.recv(1 << 16))[0] == SpeedCommand(0)
    with peer:
        assert len(read_until_closed(peer)) < sent


# -- a pseudo terminal whose other side stands ----------------------------------------------------

@pytest.fixture
def relayed(logger, running, tmp_path):
    """A link whose port is a socat, and the board at its other end; `relay` is its process."""
    near, far = tmp_path / 'near', tmp_path / 'far'
    relay = subprocess.Popen(['socat', f'pty,raw,echo=0,link={near}',
                              f'pty,raw,echo=0,link={far}'])
    until(lambda: near.exists() and far.exists())
    end = Pty(far)
    end.fd = os.open(str(far), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    board = running(CarBoard(end))
    link = running(ArduinoLink(Port(str(near)), STEADY._replace(network_silence=0.4),
                               logger=logger))
    link.board, link.relay = board, relay
    until(lambda: link.heartbeats_sent)
    yield link
    relay.send_signal(signal.SIGCONT)
    board.close()
    relay.terminate()
    relay.wait()
    os.close(end.fd)


def test_no_command_waits_in_a_pty_whose_other_side_stands(relayed, lines):
    link, board = relayed, relayed.board
    board.streaming = True
    until(lambda: link.last_frame_at)
    link.set_speed(1)
    until(board.commands)
    link.relay.send_signal(signal.SIGSTOP)
    # Speeds go on, as from a joystick. What is accepted is from before the silence was noticed.
    waiting = []

    def refuses():
        waiting.append(100 + len(waiting) % 800)
        return refusal(link.set_speed, waiting[-1])
    until(refuses, every=0.02)
    accepted = waiting[:-1]
    assert time.monotonic() - link.connection.last_byte_at >= 0.4
    # Long enough for heartbeats to fill what the other side can read.
    for speed in (-i for i in range(1, 150)):
        assert refusal(link.set_speed, speed).cause == 'silent'
        threading.Event().wait(0.01)
    board.forget()
    link.relay.send_signal(signal.SIGCONT)
    until(lambda: SpeedCommand(-500) in board.messages(),
          doing=lambda: refusal(link.set_speed, -500), every=0.02)
    speeds = [message.value for message in board.messages(SpeedCommand)]
    before = speeds[:speeds.index(-500)]
    moving = [speed for speed in before if speed]
    assert moving == accepted[:len(moving)], 'Linux cannot take these back, but all others'
    assert before[len(moving):] and not any(before[len(moving):]), 'they end with SPEED 0'
    assert len(lines('nothing received from the board for 0.4 s')) == 1


def test_the_speeds_in_a_pty_are_dropped_that_its_other_side_cannot_read_yet(relayed):
    """More than the 4095 bytes that Linux keeps for it."""
    link, board = relayed, relayed.board
    board.streaming = True
    until(lambda: link.last_frame_at)
    limit_silence(link, 0.0)
    link.relay.send_signal(signal.SIGSTOP)
    sent = link.port.bytes_sent
    number = 0
    while link.port.bytes_sent < sent + 4096:
        number += 1
        link.set_speed(number)
    last = number
    while not refusal(link.set_speed, number + 1):
        number += 1
        if time.monotonic() - link.connection.last_byte_at > 0.4:
            limit_silence(link, 0.4)
        threading.Event().wait(0.01)
    assert number > last
    board.forget()
    link.relay.send_signal(signal.SIGCONT)
    until(lambda: SpeedCommand(-500) in board.messages(),
          doing=lambda: refusal(link.set_speed, -500), every=0.02)
    assert not {*range(last + 1, number + 1)} & {
        message.value for message in board.messages(SpeedCommand)}


def test_a_board_that_talked_before_the_port_was_opened_anew_is_still_silent(relayed):
    link = relayed
    link.board.streaming = True
    until(lambda: link.last_frame_at)
    link.relay.send_signal(signal.SIGSTOP)
    link.port.give_up('opened anew')
    until(lambda: link.connection.number > 1)
    until(lambda: refusal(link.set_speed, 1), every=0.02)
    assert refusal(link.set_speed, 1).cause == 'silent'
    link.relay.send_signal(signal.SIGCONT)
    until(lambda: not refusal(link.set_speed, 1), every=0.02)


def test_a_board_behind_a_pty_that_never_talks_gets_all_commands(relayed):
    link = relayed
    more_heartbeats(link, 80)
    link.set_speed(5)
    until(lambda: link.board.commands()[-1:] == [SpeedCommand(5)])


def test_a_board_behind_a_pty_that_calibrates_may_be_silent(relayed):
    link, board = relayed, relayed.board
    board.streaming = True
    until(lambda: link.last_frame_at)
    link.calibrate_imu()
    board.streaming = False
    more_heartbeats(link, 80)
    until(lambda: board.commands() == [ImuCalibration()])
    assert refusal(link.set_speed, 1).cause == 'calibrating'


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
    for command in (*commands_of(link), lambda: link.set_speed(0)):
        assert 'calibrat' in str(refusal(command))
    line.write(arduino.encode(arduino.Ticks(1)) + arduino.encode(arduino.Voltage(12.0)))
    until(lambda: len(got) >= 2)
    assert link.calibrating, 'only IMU data ends it'
    until(lambda: not link.calibrating, doing=lambda: line.write(CarBoard.IMU), every=0.4)
    assert time.monotonic() - begun >= 0.3
    until(lambda: changes == [True, False])
    # A board that was silent for 1 s, as this test in a stall, gets SPEED 0 and no command.
    until(lambda: refusal(link.set_speed, 5) is None, doing=lambda: line.write(CarBoard.IMU))
    until(lambda: SpeedCommand(5) in board.commands())
    assert [command for command in board.commands() if command != SpeedCommand(0)] == [
        SpeedCommand(300), ImuCalibration(), SpeedCommand(5)]


def test_a_calibration_continues_after_a_reconnect_until_imu_data_goes_on(
        board, open_link, lines, monkeypatch):
    """The reconnect may have reset the board. The time of a closed port is no silence."""
    monkeypatch.setattr(calibration_module, '_SILENCE', 1.0)
    monkeypatch.setattr(calibration_module, '_GOES_ON', 0.5)
    changes = []
    link = open_link(on_calibrating=changes.append)

    def ends_since_data_goes_on():      # a stall of this machine is a silence
        link.calibrate_imu()
        with board.unplugged():
            until(lambda: not link.port.is_open)
            board.streaming = True
            assert not threading.Event().wait(1.1)
            assert link.calibrating and refusal(link.set_speed, 100)
        until(lambda: not changes[-1])
        return lines('IMU data was still received')
    again_if_stalled(ends_since_data_goes_on)
    assert not link.calibrating and link.connection.reconnects
    board.streaming = False


def test_a_calibration_ends_after_its_timeout(board, open_link):
    changes = []
    link = open_link(STEADY._replace(calibration_timeout=0.1), on_calibrating=changes.append)
    link.calibrate_imu()
    until(lambda: changes == [True, False])
    link.set_speed(1)


# -- the end --------------------------------------------------------------------------------------

def stop_and_wait(link, board):
    link.stop()
    link.join(PATIENCE)
    assert not link.port.is_open
    quiet = threading.Event()
    quiet.wait(0.1)


def test_stopping_sends_speed_0_while_the_board_sends(board, open_link):
    """The reading thread wakes often then: it must not close the port before SPEED 0 is sent."""
    link = open_link()
    board.streaming = True
    link.set_speed(300)
    until(board.commands)
    until(lambda: link.frames_received > 3)
    stopping = threading.Thread(target=link.stop, name='stopping', daemon=True)
    with link.output.lock:               # as if a command were being sent
        stopping.start()
        threading.Event().wait(0.15)  # some thirty packets
    stopping.join(PATIENCE)
    stop_and_wait(link, board)
    board.streaming = False
    until(lambda: board.messages()[-1] == SpeedCommand(0), 'the last word is SPEED 0')


def test_the_port_is_closed_only_after_speed_0_is_sent(line, board, open_link):
    """As on a UART, whose buffer empties slowly and is lost when the port is closed."""
    class SlowPort(Port):
        empty_at = 0.0
        left_at_close = None
        refused = None

        def write(self, frame):
            super().write(frame)
            if arduino.encode(SpeedCommand(0)) in frame:
                self.empty_at = time.monotonic() + 0.03

        def on_its_way(self):
            self.refused = self.refused or refusal(link.set_speed, 300)
            return time.monotonic() < self.empty_at

        def close(self):
            if self.is_open and self.left_at_close is None:
                self.left_at_close = self.on_its_way()
            super().close()

    link = open_link(port=SlowPort)
    link.set_speed(300)
    stop_and_wait(link, board)
    assert link.port.left_at_close is False and link.port.refused.cause == 'stopping'


def test_stopping_does_not_wait_for_a_board_that_does_not_read(line, open_link):
    link = open_link()
    link.set_speed(300)
    link.stop()
    link.join(10.0)      # closing would wait for 30 s
    assert not link.port.is_open


@pytest.mark.parametrize('end', [lambda output: output.end(), lambda output: output.let_go('lent')],
                         ids=['end', 'let go'])
def test_the_last_packet_to_a_port_that_takes_nothing_is_speed_0(threadless, line, end):
    """What waits in it is dropped. The heartbeat thread does not run just then."""
    link = threadless
    link.set_speed(300)
    until(lambda: refusal(link.set_led, 'x' * 30), every=0.0)
    written = len(link.port.written)
    assert link.port.bytes_sent > 1000, 'it is full'
    end(link.output)
    assert link.port.written[written:] == [b'\0' + STOP]
    received = bytearray()
    until(lambda: received.endswith(STOP), doing=lambda: received.extend(line.read(0.05)))


def test_the_last_speed_0_is_not_dropped_with_what_a_silent_board_has_not_read(threadless, line):
    """More than the 4095 bytes that Linux keeps for the other side of a pseudo terminal."""
    link = threadless
    link.set_speed(300)
    while link.port.bytes_sent < 10000:
        link.set_led('x' * 30)
    link.output.end()
    link.output.hold(True)      # the link's thread finds the silence just then
    assert read_what_was_sent(line, link).endswith(STOP)
