"""The link to the model car, over a real tty: what reaches the motor, and when."""
import threading
import time

import pytest

from boards import PATIENCE, CarBoard, wait_for
from serial_communication.links import arduino as link_module
from serial_communication.links.arduino import ArduinoLink, ArduinoSettings
from serial_communication.links.link import Refused
from serial_communication.links.port import Port
from serial_communication.protocols import arduino
from serial_communication.protocols.arduino import (Heartbeat, ImuCalibration, LedCommand,
                                                    SpeedCommand, SteeringCommand)

STEADY = ArduinoSettings(speed_timeout=0.0)       # a speed holds


@pytest.fixture
def board(line, running):
    return running(CarBoard(line))


@pytest.fixture
def open_link(line, logger, running):
    def start(settings=STEADY, ready=True, port=Port, **arguments):
        link = running(ArduinoLink(port(line.path), settings, logger=logger, **arguments))
        if ready:
            wait_for(lambda: link.heartbeats_sent)
        return link
    return start


def test_commands_reach_the_board_in_order(board, open_link):
    link = open_link()
    link.set_speed(400)
    link.set_steering(1500)
    link.set_led('left')
    link.set_speed(0)
    expected = [SpeedCommand(400), SteeringCommand(1500), LedCommand('left'), SpeedCommand(0)]
    wait_for(lambda: len(board.commands()) >= 4)
    assert board.commands() == expected


@pytest.mark.parametrize('asked, sent', [(1000, 1000), (-1000, -1000), (1001, 1000),
                                         (-1001, -1000), (32767, 1000), (10 ** 9, 1000)])
def test_a_speed_is_saturated_with_a_warning(board, open_link, lines, asked, sent):
    open_link().set_speed(asked)
    wait_for(board.commands)
    assert board.commands() == [SpeedCommand(sent)]
    assert bool(lines(str(asked))) == (asked != sent)


@pytest.mark.parametrize('text', ['x' * 31, 'blinké', 'a\0'])
def test_a_led_text_that_cannot_be_is_refused(board, open_link, text):
    link = open_link()
    with pytest.raises(Refused) as refused:
        link.set_led(text)
    assert 'refused' in str(refused.value)
    link.set_led('x' * 30)
    wait_for(board.commands)
    assert board.commands() == [LedCommand('x' * 30)]


def test_measurements_are_passed_on_with_their_stamps(board, line, open_link):
    got = []
    open_link(on_message=lambda message, stamp: got.append((message, stamp)),
              clock=lambda: 'stamp')
    sent = [arduino.Ticks(7), arduino.SteeringAngle(512), arduino.Voltage(14.5),
            arduino.Imu(16384, *[0] * 10)]
    line.write(b''.join(map(arduino.encode, sent)))
    wait_for(lambda: len(got) >= 4)
    assert got == [(message, 'stamp') for message in sent]


@pytest.mark.parametrize('check', [True, False])
def test_implausible_values_are_dropped_if_it_is_set_so(line, board, open_link, check):
    got = []
    link = open_link(STEADY._replace(check_plausibility=check),
                     on_message=lambda message, stamp: got.append(message))
    line.write(arduino.encode(arduino.SteeringAngle(2000)) + arduino.encode(arduino.Ticks(1)))
    wait_for(lambda: arduino.Ticks(1) in got)
    assert (arduino.SteeringAngle(2000) in got) != check
    assert link.decoder.errors['implausible'] == check


def test_the_boards_log_is_passed_on_sparingly(line, board, open_link, lines):
    said = []
    link = open_link(on_log=lambda severity, text: said.append((severity, text)))
    line.write(arduino.encode(arduino.Log(2, 'hot')))
    wait_for(lambda: said)
    assert said == [(2, 'hot')]
    line.write(arduino.encode(arduino.Log(0, 'again')) * 500)
    wait_for(lambda: link.frames_received >= 501)
    assert 50 <= len(said) <= 200
    assert len(lines('logs too much')) == 1


# -- the heartbeat --------------------------------------------------------------------------------

def test_heartbeats_arrive_at_about_their_rate(board, open_link):
    """Over half a second of the board's own clock: never more, and not half as many."""
    link = open_link()
    first = board.heartbeats()
    wait_for(lambda: board.heartbeats() >= first + 60)
    times = [frame.stamp for frame in board.seen if isinstance(frame.message, Heartbeat)]
    rate = (len(times) - 1) / (times[-1] - times[0])
    assert 30 < rate < 115
    assert link.heartbeats_sent >= len(times) and link.heartbeat_max_gap > 0.005


def test_the_heartbeat_rate_is_a_parameter(board, open_link):
    open_link(STEADY._replace(heartbeat_rate=20.0))
    wait_for(lambda: board.heartbeats() >= 8)
    times = [frame.stamp for frame in board.seen]
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
    wait_for(lambda: board.heartbeats() >= before + 30)
    assert not hang.is_set()
    hang.set()


def test_a_command_under_way_holds_no_heartbeat_up(open_link):
    link = open_link()
    with link._commands:
        sent = link.heartbeats_sent
        wait_for(lambda: link.heartbeats_sent > sent + 10)


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
    wait_for(lambda: not link.port.stalls)
    before = link.heartbeats_sent
    wait_for(lambda: link.heartbeats_sent > before + 20)
    times = link.port.written
    within = [moment for moment in times if moment < times[0] + 0.05]
    assert len(within) <= 9, 'five periods, and a few for the stall'


# -- the speed timeout ----------------------------------------------------------------------------

def test_speed_0_follows_once_if_no_speed_command_comes(board, open_link, lines):
    link = open_link(ArduinoSettings(speed_timeout=0.1))
    link.set_speed(300)
    wait_for(lambda: SpeedCommand(0) in board.commands())
    first = [frame.stamp for frame in board.seen if frame.message == SpeedCommand(300)][0]
    second = [frame.stamp for frame in board.seen if frame.message == SpeedCommand(0)][0]
    assert second - first >= 0.08
    before = board.heartbeats()
    wait_for(lambda: board.heartbeats() >= before + 30)
    assert board.commands() == [SpeedCommand(300), SpeedCommand(0)]
    wait_for(lambda: lines('SPEED 0 sent'))
    assert len(lines('SPEED 0 sent')) == 1


def test_speed_commands_that_go_on_hold_the_timeout_off(board, open_link):
    link = open_link(ArduinoSettings(speed_timeout=1.0))
    begun = time.monotonic()
    while time.monotonic() < begun + 1.3:
        link.set_speed(200)
        time.sleep(0.02)
    assert set(board.commands()) == {SpeedCommand(200)}
    link.set_speed(0)


def test_without_a_timeout_or_a_speed_nothing_follows(board, open_link):
    link = open_link(ArduinoSettings(speed_timeout=0.05))
    link.set_speed(0)
    link.set_steering(1500)
    before = board.heartbeats()
    wait_for(lambda: board.heartbeats() >= before + 25)
    assert board.commands() == [SpeedCommand(0), SteeringCommand(1500)]


def test_a_timeout_of_0_is_never(board, open_link):
    open_link(ArduinoSettings(speed_timeout=0.0)).set_speed(77)
    before = board.heartbeats()
    wait_for(lambda: board.heartbeats() >= before + 80)
    assert board.commands() == [SpeedCommand(77)]


# -- the port goes and comes ----------------------------------------------------------------------

def test_commands_to_a_closed_port_are_refused_and_not_kept(board, open_link):
    link = open_link()
    with board.unplugged():
        wait_for(lambda: not link.port.is_open)
        for command in (lambda: link.set_speed(500), lambda: link.set_steering(1),
                        lambda: link.set_led('left'), link.calibrate_imu):
            with pytest.raises(Refused) as refused:
                command()
            assert 'closed' in str(refused.value)
        assert not link.calibrating
    before = board.heartbeats()
    wait_for(lambda: board.heartbeats() >= before + 20)
    assert board.commands() == [] and link.reconnects == 1


@pytest.mark.parametrize('speed, after', [(500, [SpeedCommand(0)]), (0, [])])
def test_after_a_reconnect_only_a_moving_car_is_stopped(board, open_link, speed, after):
    link = open_link()
    link.set_speed(speed)
    link.set_steering(1234)
    wait_for(lambda: len(board.commands()) == 2)
    with board.unplugged():
        wait_for(lambda: not link.port.is_open)
        del board.seen[:]
    wait_for(lambda: board.heartbeats() >= 30)
    assert board.commands() == after
    if after:
        assert board.messages()[0] == SpeedCommand(0), 'before any heartbeat'


def test_no_heartbeat_is_counted_while_the_port_is_closed(board, open_link):
    link = open_link()
    with board.unplugged():
        wait_for(lambda: not link.port.is_open)
        wait_for(lambda: not link._open.is_set())
        sent = link.heartbeats_sent
        assert not threading.Event().wait(0.1)
        assert link.heartbeats_sent == sent


# -- calibration ----------------------------------------------------------------------------------

def test_a_calibration_stops_the_car_and_refuses_commands_until_imu_data_returns(
        board, line, open_link, monkeypatch):
    monkeypatch.setattr(link_module, '_CALIBRATION_ECHO', 0.3)
    changes, got = [], []
    link = open_link(on_calibrating=changes.append,
                     on_message=lambda message, stamp: got.append(message))
    link.set_speed(300)
    begun = time.monotonic()
    link.calibrate_imu()
    wait_for(lambda: len(board.commands()) >= 3)
    assert board.commands() == [SpeedCommand(300), SpeedCommand(0), ImuCalibration()]
    assert link.calibrating and changes == [True]
    for command in (lambda: link.set_speed(500), lambda: link.set_speed(0),
                    lambda: link.set_steering(1), lambda: link.set_led('left'),
                    link.calibrate_imu):
        with pytest.raises(Refused) as refused:
            command()
        assert 'calibrat' in str(refused.value)
    line.write(arduino.encode(arduino.Ticks(1)) + arduino.encode(arduino.Voltage(12.0)))
    wait_for(lambda: len(got) >= 2)
    assert link.calibrating, 'only IMU data ends it'
    board.streaming = True
    wait_for(lambda: not link.calibrating)
    assert time.monotonic() - begun >= 0.3, 'packets that were under way do not end it'
    wait_for(lambda: changes == [True, False])
    link.set_speed(5)
    wait_for(lambda: board.commands()[-1] == SpeedCommand(5))
    assert len(board.commands()) == 4
    board.streaming = False


def test_heartbeats_go_on_during_a_calibration(board, open_link):
    link = open_link()
    link.calibrate_imu()
    before = board.heartbeats()
    wait_for(lambda: board.heartbeats() >= before + 20)
    assert link.calibrating


def test_a_calibration_without_an_end_is_over_after_its_timeout(board, open_link):
    changes = []
    link = open_link(STEADY._replace(calibration_timeout=0.1), on_calibrating=changes.append)
    link.calibrate_imu()
    wait_for(lambda: changes == [True, False], 4.0, 'the end of the calibration')
    link.set_speed(1)


def test_a_calibration_lasts_through_a_reconnect(board, open_link):
    link = open_link()
    link.calibrate_imu()
    with board.unplugged():
        wait_for(lambda: not link.port.is_open)
    wait_for(lambda: link.port.is_open and link.reconnects)
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
    wait_for(board.commands)
    stop_and_listen(link, board)
    assert board.messages()[-1] == SpeedCommand(0)
    with pytest.raises(Refused):
        link.set_speed(300)


def test_stopping_sends_speed_0_also_while_the_board_talks(board, open_link):
    """The reading thread wakes often then: it must not close the port before the last word."""
    link = open_link()
    board.streaming = True
    link.set_speed(300)
    wait_for(board.commands)
    wait_for(lambda: link.frames_received > 3)
    stopping = threading.Thread(target=link.stop, name='stopping', daemon=True)
    with link._commands:              # as if a command were just on its way
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

        def backlog(self):
            return max(0.0, self.empty_at - time.monotonic())

        def close(self):
            if self.is_open and self.left_at_close is None:
                self.left_at_close = self.backlog()
            super().close()

    link = open_link(port=SlowPort)
    link.set_speed(300)
    stop_and_listen(link, board)
    assert link.port.left_at_close == 0.0


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
