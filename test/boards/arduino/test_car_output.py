"""What reaches the board, and when, over a line with a baud rate; the tests set the time."""
from unittest import mock

import pytest

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.framing.layout import Value, message_class
from serial_communication.link.link import Refused
from serial_communication.transport.port import Port, PortBusy

STEP = 0.0005      # s
BEAT_MISSED = 0.03      # s without a heartbeat after which the board stops its motor
STOP = arduino.encode(arduino.SpeedCommand(0))
STRIP = message_class('strip', 32, '<B*', [Value('data')])


class Uart(Port):
    """A port whose board gets the bytes at the baud rate, but none while it `stands`.

    With `usb` it reports what waits as cdc_acm does: 1280 bytes for each write, for 1 ms; it takes
    16 writes at most. With `flushes` False it cannot drop what waits.
    """

    is_open = True

    def __init__(self, baud=115200, usb=False, flushes=True):
        super().__init__('/dev/null', baud)
        self.now, self.stands = 100.0, False
        self.received = []      # (when, when it was written, packet)
        self.dropped = []       # packets
        self._usb, self._flushes = usb, flushes
        self._queue = []        # of [s until it is sent, when it was written, packet]

    def step(self):
        self.now += STEP
        left = 0.0 if self.stands else STEP
        while self._queue and left > 0:
            part = min(left, self._queue[0][0])
            self._queue[0][0] -= part
            left -= part
            if self._queue[0][0] < 1e-9:
                self.received.append((self.now, *self._queue.pop(0)[1:]))

    def backlog(self):
        return 1280 * 10 / self.baud * len(self._queue) if self._usb else \
            sum(seconds for seconds, *_ in self._queue)

    def write(self, frame):
        if self._usb and len(self._queue) == 16:
            raise PortBusy('the port takes no data')
        seconds = 0.001 if self._usb else len(frame) * 10 / self.baud
        self._queue.append([seconds, self.now, frame])

    def discard_output(self, why=''):
        self.dropped += [packet for _seconds, _at, packet in self._queue]
        if self._flushes:
            self._queue.clear()
        return True


@pytest.fixture
def start(logger):
    def start_link(**options):
        port = Uart(**options)
        link = ArduinoLink(port, ArduinoSettings(speed_timeout=0.0), logger=logger,
                           now=lambda: port.now)
        link.log.warn = mock.Mock()
        link.output.motor.awake(port.now)
        return link
    return start_link


def blocked(link):
    """How often it was said that the port takes no data."""
    return [call.args[0] for call in link.log.warn.call_args_list].count('blocked')


def run(link, seconds, command=lambda: None, every=1.0):
    """Send heartbeats for so long, and from time to time commands; return how many are refused."""
    refused = 0
    for step in range(round(seconds / STEP)):
        if step % round(every / STEP) == round(every / STEP) // 2 + 11:
            try:
                command()
            except Refused:
                refused += 1
        if step % round(0.01 / STEP) == 0:
            link.output.send_what_is_due(True)
        link.port.step()
    return refused


@pytest.mark.parametrize('times, size', [(10, 33), (2, 150), (2, 200), (10, 55), (2, 254), (1, 9)])
@pytest.mark.parametrize('usb', [False, True], ids=['uart', 'usb'])
def test_many_commands_at_once_are_accepted_and_delay_no_heartbeat(start, times, size, usb):
    link = start(usb=usb)

    def burst():
        for _ in range(times):
            link.command(STRIP([7] * size))
    assert run(link, 3.0, burst, 0.1) == 0
    run(link, 0.1)
    beats = [at for at, _written, packet in link.port.received
             if packet == arduino.encode(arduino.Heartbeat())]
    assert max(after - before for before, after in zip(beats, beats[1:])) < BEAT_MISSED
    assert len(beats) == 310 + link.heartbeats_sent
    assert len([packet for *_, packet in link.port.received if len(packet) > size]) == 30 * times
    assert link.port.dropped == [] and not blocked(link)


def test_more_commands_than_the_line_can_send_are_refused(start):
    link = start()

    def burst():
        for _ in range(10):
            link.command(STRIP([7] * 200))
    assert run(link, 1.0, burst, 0.1) == 10
    assert link.port.dropped == []
    assert max(at - written for at, written, _packet in link.port.received) < 0.08


def test_a_slow_line_may_need_longer_for_one_command_than_a_port_may_stand(start):
    link = start(baud=4800)
    run(link, 3.0, lambda: link.command(STRIP([7] * 250)), 2.0)
    assert link.port.dropped == [] and not blocked(link)


@pytest.mark.parametrize('seconds', [0.1, 0.5, 1.5, 4.0])
@pytest.mark.parametrize('usb', [False, True], ids=['uart', 'usb'])
def test_no_old_command_leaves_a_port_that_has_stood(start, seconds, usb):
    link, speed = start(usb=usb), [0]

    def drive():
        speed[0] += 1
        link.set_speed(speed[0])
    run(link, 1.0, drive, 0.05)
    link.port.stands = True
    refused = run(link, seconds, drive, 0.05)
    assert refused >= (seconds - 0.4) / 0.05
    link.port.stands = False
    since = len(link.port.received)
    run(link, 1.0)
    after = link.port.received[since:]
    assert max(at - written for at, written, _packet in after) < 0.4
    stops = [index for index, (*_, packet) in enumerate(after) if packet.endswith(STOP)]
    if seconds > 0.4:
        assert stops[:1] == [0] and link.port.dropped
        assert blocked(link)
    else:
        assert refused == 0 and stops == [] and link.port.dropped == [] and not blocked(link)
    assert run(link, 1.0, drive, 0.05) == 0


def test_where_nothing_can_be_dropped_it_is_tried_every_0_3_s(start):
    link = start(flushes=False)
    run(link, 1.0)
    link.port.stands = True
    run(link, 3.0)
    assert blocked(link) in (9, 10)


def test_a_port_that_is_faster_than_its_baud_rate_stands_as_soon(start):
    """Much was sent through it before."""
    link = start(usb=True)
    run(link, 5.0, lambda: link.command(STRIP([7] * 250)), 0.01)
    link.port.stands = True
    run(link, 0.6)
    assert link.port.dropped


def test_a_port_that_was_away_takes_all_commands_when_it_is_open_again(start):
    link = start(usb=True)
    run(link, 1.0, lambda: link.set_speed(300), 0.05)
    link.port.is_open = False
    link.output.closed()
    run(link, 60.0)
    link.port.is_open = True
    link.set_speed(300)     # before the next heartbeat
    assert run(link, 1.0, lambda: link.set_speed(300), 0.05) == 0
    assert link.port.dropped == []


def test_after_a_stall_no_heartbeat_precedes_speed_0(start, monkeypatch):
    """The bridge stalls as a command is about to be written, and the line is busy."""
    link = start()
    run(link, 1.0, lambda: link.set_speed(300))
    for size in 250, 27:        # so that a heartbeat would precede the next
        link.command(STRIP([7] * size))
    now = link.port.now
    monkeypatch.setattr(link.output, '_now', lambda: link.port.now + 2.0)
    with pytest.raises(Refused):
        link.output._send(arduino.SpeedCommand(1), now)
    run(link, 0.1)
    packets = [packet for *_, packet in link.port.received]
    assert packets[packets.index(arduino.encode(STRIP([7] * 27))) + 1] == STOP
