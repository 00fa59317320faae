"""A port that is lent to another program, and a board that is reset, over real ttys."""
import fcntl
import os
import signal
import subprocess
import sys
import termios
import threading
import time
from unittest import mock

import pytest
import serial.serialposix

from fake_boards import PATIENCE, BusBoard, until
from waiting import Waiter, again_if_stalled
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.boards.bus import wire as bus_wire
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.link import McuLink
from serial_communication.link import lending
from serial_communication.link.link import OK, WARN, ERROR, Refused
from serial_communication.link.outcome import NOT_SENT
from serial_communication.transport import open_port
from serial_communication.transport.port import Port

STOP = arduino.encode(arduino.SpeedCommand(0))
STEADY = ArduinoSettings(speed_timeout=0.0)
STATUS = mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)

_BORROWER = '''
import sys, time, serial
port = serial.Serial(sys.argv[1], 9600, xonxoff=True, exclusive=True)
print('open', flush=True)
exec(sys.argv[2])
'''


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """No link takes too long to close its port because this machine stalls."""
    monkeypatch.setattr(lending, '_CLOSES_WITHIN', 10.0)


@pytest.fixture
def borrow(line):
    """A function that opens the tty in another program, which then runs some Python."""
    begun = []

    def start(then='time.sleep(600)'):
        begun.append(subprocess.Popen([sys.executable, '-c', _BORROWER, line.path, then],
                                      stdout=subprocess.PIPE))
        assert begun[-1].stdout.readline() == b'open\n', 'it is locked'
        return begun[-1]

    yield start
    for process in begun:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def car(open_link):
    """A link to a car that drives; the test has the board's end as `line`."""
    link = open_link(ArduinoLink, STEADY)
    until(lambda: link.heartbeats_sent)
    link.set_speed(500)
    return link


def refused(why):
    return False, f'status 253 (not sent): {why}'


def lent(link, by='avrdude', seconds=10.0):
    assert link.lending.lend(by, seconds) == (True, f'lent to {by} for {seconds:g} s')
    assert not link.port.is_open


def back(link):
    until(lambda: link.port.is_open and link.connection.state.name != 'CLOSED')


def packets(data):
    """The packets in what the board received, without heartbeats."""
    return [part + b'\0' for part in data.split(b'\0') if part not in (b'', b'\x02\x0b')]


# -- the loan -------------------------------------------------------------------------------------

def test_a_lent_port_is_free_until_it_is_given_back(line, open_link, borrow):
    link = open_link(McuLink)
    lent(link)
    assert link.condition(0.0) == (WARN, 'lent to avrdude')
    assert link.report(0.0).level == WARN
    other = borrow('sys.stdin.read()')
    assert link.lending.lend('avrdude', 0) == (True, 'the port is opened again')
    other.kill()
    other.wait()
    back(link)
    until(lambda: link.frames_received or line.write(STATUS))
    assert link.condition(time.monotonic())[0] == OK and link.port.loan is None


@pytest.mark.parametrize('asked', [0.4, 60.0, float('inf')])
def test_a_loan_ends_by_itself_after_its_time_or_10_s(open_link, monkeypatch, asked):
    monkeypatch.setattr(lending, 'LONGEST_LOAN', 0.4)
    link = open_link(McuLink)

    def ends_in_time():
        began = time.monotonic()
        answer = link.lending.lend('arduino-cli', asked)
        back(link)
        took = time.monotonic() - began
        assert took >= 0.4
        return answer == (True, 'lent to arduino-cli for 0.4 s') and took < 3.0
    again_if_stalled(ends_in_time)
    assert lending.LONGEST_LOAN == 0.4 and link.port.loan is None


def test_10_s_are_the_longest_loan(open_link):
    link = open_link(McuLink)
    assert link.lending.lend('me', 3600)[1] == 'lent to me for 10 s'
    assert link.port.loan.until - open_port.time.clock_gettime(time.CLOCK_BOOTTIME) <= 10.0


def test_a_renewed_loan_goes_on_and_one_that_is_not_ends(open_link):
    link = open_link(McuLink)

    def goes_on():
        began, before = time.monotonic(), link.connection.number
        while time.monotonic() < began + 2.0:       # longer than the pause between two openings
            is_lent, words = link.lending.lend('avrdude', 0.8)
            if not is_lent or link.connection.number > before:
                return False        # it was renewed too late
            assert words == 'lent to avrdude for 0.8 s'
            threading.Event().wait(0.05)
        back(link)
        return link.connection.number == before + 1
    again_if_stalled(goes_on)


def test_a_loan_has_one_name(open_link, lines):
    link = open_link(McuLink)
    lent(link, 'avrdude (pid 7)')
    assert link.lending.lend('minicom', 5.0) == refused('the port is lent to avrdude (pid 7)')
    assert not link.lending.lend('minicom', 0.0)[0] and link.port.loan.runs
    assert link.lending.lend('avrdude (pid 7)', 0.0)[0] and not link.port.loan.runs
    back(link)
    lent(link, 'minicom')


@pytest.mark.parametrize('by, seconds', [('', 5.0), (' ', 5.0), ('x', -1.0), ('x', float('nan'))])
def test_a_wrong_loan_is_refused(open_link, by, seconds):
    link = open_link(McuLink)
    done, text = link.lending.lend(by, seconds)
    assert not done and 'are needed' in text and link.port.is_open


def test_a_name_is_one_short_line(open_link):
    link = open_link(McuLink)
    assert link.lending.lend('a\nb' + 'c' * 500, 5.0)[0]
    assert link.condition(0.0)[1] == 'lent to a\ufffdb' + 'c' * 57


def test_after_the_loan_the_port_waits_for_a_program_that_still_has_it_open(open_link, borrow):
    """Whoever renewed the loan was killed, and its upload goes on."""
    link = open_link(McuLink)
    lent(link)
    upload = borrow()
    link.lending.lend('avrdude', 0.1)
    until(lambda: 'still open' in link.connection.trouble)
    assert link.condition(0.0) == (
        ERROR, f'closed: it was lent to avrdude, and is still open in '
        f'{os.path.basename(sys.executable)} (pid {upload.pid})')
    lent(link, 'another')       # it can be lent again
    link.lending.lend('another', 0.1)
    until(lambda: 'was lent to another' in link.connection.trouble)
    os.kill(upload.pid, signal.SIGKILL)
    back(link)


def test_what_the_borrower_did_to_the_tty_is_put_right(line, open_link, borrow):
    link = open_link(McuLink)
    lent(link)
    borrow('import termios, os; os.system("stty sane ixon 9600 < " + sys.argv[1]); '
           'termios.tcflow(port.fileno(), termios.TCOOFF)').wait()
    changed = subprocess.check_output(['stty', '-F', line.path])
    assert b'9600' in changed and b'-icanon' not in changed
    link.lending.lend('avrdude', 0)
    back(link)
    every = bytes(range(256))
    link.port.write(every)
    assert line.read_all() == every
    until(lambda: link.frames_received or line.write(STATUS))
    assert b'115200' in subprocess.check_output(['stty', '-F', line.path])


def test_a_port_that_is_absent_can_be_lent_and_stays_closed_when_it_is_there(line, open_link):
    link = open_link(McuLink)
    line.unplug()
    until(lambda: not link.port.is_open)
    lent(link)
    line.plug()
    until(lambda: link.connection.trouble == 'lent to avrdude')
    time.sleep(1.1)     # longer than the pause between two openings
    assert link.condition(0.0) == (WARN, 'lent to avrdude') and not link.port.is_open
    link.lending.lend('avrdude', 0)
    back(link)


def test_a_port_that_is_lent_while_it_is_opened_is_never_written_to(line, logger, running):
    """The opener's thread has it open already, but has not said so yet."""
    opening, go_on = threading.Event(), threading.Event()

    class Slow(Port):
        opened = 0

        def _refuse_while_lent(self, path):
            super()._refuse_while_lent(path)
            self.opened += 1
            if self.opened == 1:
                opening.set()
                go_on.wait()

    link = running(ArduinoLink(Slow(line.path), STEADY, logger=logger))
    opening.wait()
    lender = Waiter(link.lending.lend, 'avrdude', 10.0)
    until(lambda: link.port.loan)
    assert not lender.answer, 'it is told before the port is closed'
    go_on.set()
    assert lender.result() == (True, 'lent to avrdude for 10 s')
    assert line.read(0.0) == b'' and link.port.has_closed()
    link.lending.lend('avrdude', 0)
    assert packets(line.read(PATIENCE))[0] == STOP
    back(link)


@pytest.mark.parametrize('is_open', [True, False])
def test_of_two_who_want_to_borrow_a_port_at_once_one_is_told_that_it_is_lent(
        line, open_link, monkeypatch, is_open):
    """The second one has found that it is not lent; the first one's call overtakes it."""
    link = open_link(McuLink)
    if not is_open:
        line.unplug()
        until(lambda: not link.port.is_open)
    owner, name = (link.lending, '_do') if is_open else (link.port, 'lend_closed')
    go_on, first = getattr(owner, name), []

    def overtaken(argument):
        monkeypatch.setattr(owner, name, go_on)
        first.append(link.lending.lend('first', 10.0))
        return go_on(argument)

    monkeypatch.setattr(owner, name, overtaken)
    assert link.lending.lend('second', 10.0) == refused('the port is lent to first')
    assert first == [(True, 'lent to first for 10 s')] and link.port.loan.by == 'first'


def test_a_loan_that_is_over_before_it_can_be_confirmed_is_refused(open_link, monkeypatch):
    """The caller's thread stalls while the port closes."""
    link = open_link(McuLink)
    monkeypatch.setattr(link.port, 'has_closed',
                        lambda: not (link.port.loan and link.port.loan.runs))
    assert link.lending.lend('me', 0.2) == refused(
        f'the loan was over before it could be confirmed: {lending.STALLED}')


def test_a_loan_can_be_ended_while_the_port_still_closes(open_link, monkeypatch):
    link, close, go_on = open_link(McuLink), Port.close, threading.Event()
    monkeypatch.setattr(link.port, 'close', lambda: go_on.wait(PATIENCE) and close(link.port))
    lender = Waiter(link.lending.lend, 'me', 10.0)
    until(lambda: link.port.loan)
    assert link.lending.lend('me', 0.0) == (True, 'the port is opened again')
    assert not link.port.loan.runs
    go_on.set()
    assert not lender.result()[0], 'nor is the first call told that it is lent'
    back(link)


def test_an_opening_that_hangs_is_not_lent(line, logger, running, monkeypatch):
    monkeypatch.setattr(lending, '_CLOSES_WITHIN', 0.2)
    opening, go_on = threading.Event(), threading.Event()

    class Hanging(Port):
        def _refuse_while_lent(self, path):
            opening.set()
            go_on.wait()

    link = running(McuLink(Hanging(line.path), logger=logger))
    opening.wait()
    assert link.lending.lend('me', 5.0) == refused(
        'the port is just being opened or closed, which takes long')
    assert not link.port.loan.runs
    go_on.set()


def test_a_link_whose_thread_hangs_lends_nothing(open_link, monkeypatch, line):
    monkeypatch.setattr(lending, '_CLOSES_WITHIN', 0.2)
    link = open_link(McuLink)
    hangs, go_on = threading.Event(), threading.Event()
    link.tap = lambda *_: hangs.set() or go_on.wait()
    until(lambda: hangs.is_set() or line.write(STATUS))
    done, text = link.lending.lend('me', 5.0)
    assert not done and text.startswith('status 254 (not known): the link did not confirm')
    assert link.port.is_open
    link.tap = None
    go_on.set()
    until(lambda: link.lending._task is None)
    assert link.port.is_open and link.port.loan is None


@pytest.mark.parametrize('may_be_old', [
    lambda: True, lambda: threading.current_thread() is not threading.main_thread()],
    ids=['the caller', "the link's thread"])
def test_a_call_from_before_a_stall_lends_and_resets_nothing(open_link, monkeypatch, may_be_old):
    """The parameter: who finds the stall."""
    link = open_link(McuLink)
    monkeypatch.setattr(link.lending, '_may_be_old', may_be_old)
    for answer in link.lending.lend('me', 5.0), reset_by(link, 'rts'):
        assert answer == refused(lending.STALLED)
    assert link.port.is_open and link.connection.number == 1


# -- the car --------------------------------------------------------------------------------------

def test_a_port_is_lent_with_speed_0_first_then_silence_and_opened_with_speed_0(line, car):
    until(lambda: line.read(1.0))
    lent(car)
    sent = line.read_all()
    assert packets(sent)[-1] == STOP and sent.endswith(STOP), 'SPEED 0 is the last packet'
    for command in (lambda: car.set_speed(300), lambda: car.set_steering(1500),
                    lambda: car.set_led('left'), car.calibrate_imu):
        with pytest.raises(Refused, match='lent to avrdude'):
            command()
    assert line.read(0.5) == b''
    car.lending.lend('avrdude', 0)
    assert packets(line.read(PATIENCE))[0] == STOP
    assert not car.announcement.is_current


def test_no_command_of_any_thread_follows_the_last_speed_0(line, car):
    """Commands at full rate from several threads, while the port is lent again and again."""
    ending = threading.Event()

    def command():
        while not ending.is_set():
            try:
                car.set_speed(700)
            except Refused:
                time.sleep(0.001)

    drivers = [Waiter(command) for _ in range(3)]
    received = []
    reader = Waiter(lambda: [received.append(line.read(0.02)) for _ in iter(ending.is_set, True)])
    try:
        for _ in range(5):
            back(car)
            lent(car, seconds=5.0)
            seen = len(received)    # a read that has begun since then finds nothing
            until(lambda: len(received) > seen + 1 and not received[-1])
            assert b''.join(received).endswith(STOP)
            car.lending.lend('avrdude', 0)
            until(lambda: car.port.is_open)
    finally:
        ending.set()
        for waiter in (*drivers, reader):
            waiter.join()


def test_a_car_that_calibrates_is_not_lent(line, car):
    car.calibrate_imu()
    done, text = car.lending.lend('avrdude', 5.0)
    assert (done, text) == refused('not now: the board calibrates its IMU, which takes minutes')
    assert car.port.is_open and car.port.loan is None


def test_a_car_whose_port_takes_nothing_is_lent_with_speed_0_last(line, car):
    """What waits in the port is dropped, so that it takes SPEED 0."""
    with mock.patch.object(car.heartbeat, '_work', lambda heartbeat_due: False):
        with pytest.raises(Refused, match='takes no data'):
            while True:
                car.set_led('x' * 30)
        lent(car)
    received = bytearray()
    until(lambda: received.endswith(STOP), doing=lambda: received.extend(line.read(0.05)))
    assert len(received) > 1000 and line.read(0.3) == b''
    car.lending.lend('avrdude', 0)
    assert STOP in line.read(5.0)[:len(STOP) + 1]


# -- the bus --------------------------------------------------------------------------------------

@pytest.fixture
def bus(line, running, open_link):
    """A link with its board."""
    board = running(BusBoard(line))
    link = open_link(BusLink, BusSettings(environment_period=0.0))
    until(lambda: link.condition(0.0)[0] == OK)
    link.board = board
    return link


def test_no_port_is_lent_during_a_move(bus):
    bus.board.script.append(b'')
    caller = Waiter(bus.lift, 0, 100)
    until(bus.board.moves)
    for done, text in bus.lending.lend('avrdude', 5.0), reset_by(bus, 'dtr'):
        assert not done and 'not now: "lift up 100' in text and 'is under way' in text
    assert bus.port.is_open
    bus.board.say(bus_wire.Reply(bus_wire.OK, b''))
    assert caller.result().success
    lent(bus)


def test_calls_on_a_lent_port_are_not_sent(bus):
    lent(bus)
    outcome = bus.lift(0, 100)
    assert outcome.status == NOT_SENT and 'lent to avrdude' in outcome.message
    assert not bus.board.moves()


# -- reset ----------------------------------------------------------------------------------------

def reset_by(link, line):
    link.lending.line, link.port.is_pty = line, False
    return link.lending.reset()


@pytest.fixture
def lines_of_port(monkeypatch, line):
    """Give the pseudo terminal control lines: their changes, with the bytes received before."""
    changes, ioctl = [], fcntl.ioctl
    bits = {termios.TIOCMBIS: True, termios.TIOCMBIC: False}
    names = {termios.TIOCM_DTR: 'dtr', termios.TIOCM_RTS: 'rts'}

    def fake(fd, request, argument=0, *more):
        if request not in bits:
            return ioctl(fd, request, argument, *more)
        name = names[int.from_bytes(argument, sys.byteorder)]
        changes.append((name, bits[request], time.monotonic(), line.read_all(0.0)))
        return argument

    monkeypatch.setattr(serial.serialposix.fcntl, 'ioctl', fake)
    monkeypatch.setattr(open_port, '_PTY', ())
    return changes


@pytest.mark.parametrize('by, expected', [
    ('dtr', [('dtr', False), ('dtr', True)]),
    ('rts', [('dtr', False), ('rts', True), ('rts', False)])])
def test_a_reset_is_a_pulse_between_speed_0_and_a_new_opening(lines_of_port, line, car, by,
                                                              expected):
    del lines_of_port[:]
    until(lambda: line.read(1.0))
    assert reset_by(car, by) == (True, f'reset by {by.upper()}')
    until(lambda: car.connection.number == 2)
    pulse, opening = lines_of_port[:len(expected)], lines_of_port[len(expected):]
    assert [each[:2] for each in pulse] == expected
    assert packets(pulse[0][3])[-1] == STOP, 'SPEED 0 is sent before it'
    assert not any(each[3] for each in (*pulse[1:], *opening)), 'nothing is sent during it'
    assert pulse[-1][2] - pulse[-2][2] >= 0.1
    assert packets(line.read(5.0))[0] == STOP and not car.announcement.is_current


def test_a_board_without_such_a_line_is_not_reset(open_link, car, running, logger):
    assert car.lending.reset() == refused(
        'no line that resets this board is known (parameter reset_line)')
    car.lending.line = 'dtr'
    assert car.lending.reset() == refused(f'the port {car.port.url} has no control lines')
    assert car.port.is_open and car.connection.number == 1
    loop = running(McuLink(Port('loop://'), logger=logger))
    until(lambda: loop.port.is_open)
    assert reset_by(loop, 'rts')[0] is False
    until(lambda: loop.port.is_open)


def test_a_pulse_that_fails_is_reported_and_the_port_is_opened_again(line, car):
    """A tty whose driver has no such lines."""
    done, text = reset_by(car, 'dtr')
    assert not done and text
    until(lambda: car.connection.number == 2)
    back(car)


def test_a_reset_ends_a_calibration_with_speed_0_first(lines_of_port, line, running, logger):
    changes = []
    car = running(ArduinoLink(Port(line.path), STEADY, logger=logger,
                              on_calibrating=changes.append))
    until(lambda: car.heartbeats_sent)
    car.calibrate_imu()
    del lines_of_port[:]
    until(lambda: line.read(1.0))
    assert reset_by(car, 'dtr') == (True, 'reset by DTR')
    assert packets(lines_of_port[0][3])[-1] == STOP and changes == [True, False]
    until(lambda: car.connection.number == 2)
    back(car)
    car.set_speed(1)


def test_a_closed_port_is_not_reset(line, car):
    line.unplug()
    until(lambda: not car.port.is_open)
    assert reset_by(car, 'dtr') == refused('the port is closed')
