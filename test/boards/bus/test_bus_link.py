"""The bus link and a board, over a real tty."""
import socket
import time

import pytest

from fake_boards import PATIENCE, BusBoard, until
from lines import Pty
from waiting import Waiter
from serial_communication.link import link as link_module
from serial_communication.link.connection import Connection, PortState
from serial_communication.boards.bus.call import NOT_READY_WAIT, Call
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.bus.polls import Poller
from serial_communication.link.link import ERROR, OK, RX, TX, WARN
from serial_communication.boards.bus.session import Condition
from serial_communication.link.outcome import NOT_SENT, TIMEOUT
from serial_communication.transport.port import Port, PortBusy
from serial_communication.boards.bus import wire as bus

SHORT = BusSettings(reply_timeout=0.15, motion_timeout=0.3, environment_period=0.0)
PATIENT = BusSettings(reply_timeout=PATIENCE, motion_timeout=PATIENCE, environment_period=0.0)
LIFT = bus.lift(0, 100)
OK_WIRE = bus.encode_reply(bus.Reply(bus.OK))


def echo(link):
    return link.call(bus.ECHO_FUNCTION, (b'mine',))


def is_move(request):
    return request.cmd1 == bus.FUNCTION and request != bus.ENVIRONMENT_REQUEST


@pytest.fixture(autouse=True)
def never_stalls(monkeypatch):
    """No call is refused because this machine stalls; test/link/test_stall.py tests that."""
    monkeypatch.setattr(Connection, 'may_be_from_a_stall', lambda self: False)


@pytest.fixture
def board(line, running):
    return running(BusBoard(line))


@pytest.fixture
def open_link(line, logger, running):
    """A function that starts a link with the given settings and waits until it is ready."""
    def start(settings=PATIENT, ready=True, **arguments):
        link = running(BusLink(Port(line.path), settings, logger=logger, **arguments))
        if ready:
            until(lambda: link.master.synchronised and link.master.in_step)
        return link
    return start


def test_every_function_has_an_outcome(board, open_link):
    link = open_link()
    assert link.lift(0, 100).success and link.gimbal(3, 45).success
    outcome, reading = link.environment()
    assert outcome.success and reading == (350, 25.63, 48.12)
    assert echo(link).success and link.call(bus.SYNC_FUNCTION, ()).success
    assert link.request(bus.Request(bus.FUNCTION, 0x30, b'\xa5\x5a')).success
    assert board.executed == [LIFT, bus.gimbal(3, 45), bus.ENVIRONMENT_REQUEST,
                              bus.Request(bus.FUNCTION, 0x30, b'\xa5\x5a')]
    assert board.requests()[0] == bus.SYNC_REQUEST
    values = dict(link.report(time.monotonic()).values)
    assert values['timeouts'] == 0 and float(values['round trip p50 [ms]']) >= 0
    assert link.report(time.monotonic())[:2] == (OK, 'ready')


def test_the_environment_is_polled_and_published(board, open_link):
    readings = []
    open_link(PATIENT._replace(environment_period=0.01), clock=lambda: 'stamp',
              on_environment=lambda reading, stamp: readings.append((reading, stamp)))
    until(lambda: len(readings) >= 5)
    assert set(readings) == {((350, 25.63, 48.12), 'stamp')}
    assert set(board.executed) == {bus.ENVIRONMENT_REQUEST}


def test_a_poller_skips_missed_periods():
    class Asked:
        outcome = 'answered'

    asked, now = [], [0.0]
    poller = Poller(1.0, lambda: asked.append(now[0]) or Asked())
    poller.start(10.0)
    for now[0] in (10.0, 10.5, 11.25, 11.75, 12.0, 17.5, 18.0, 18.5, 19.0, 19.5):
        poller.tick(now[0])
    assert asked == [10.0, 11.25, 12.0, 17.5, 18.5, 19.5]
    Asked.outcome = None        # without an outcome there is no new poll
    for now[0] in (20.5, 21.5, 22.5):
        poller.tick(now[0])
    assert len(asked) == 6


def test_settings_change_the_frames(line, running, logger):
    board = running(BusBoard(line, has_cmd2=True))
    link = running(BusLink(Port(line.path), PATIENT._replace(
        reply_has_cmd2=True, environment_datelen=0), logger=logger))
    until(lambda: link.master.synchronised)
    assert link.environment()[0].success
    assert bus.encode_request(bus.ENVIRONMENT_REQUEST, 0) in [frame.raw for frame in board.frames]


def test_callers_in_many_threads_get_their_own_replies(board, open_link):
    board.rule = lambda request: (
        bus.encode_reply(bus.Reply(bus.OK, request.data[::-1])) if is_move(request) else None)
    link = open_link()

    def call(base):
        return all(link.request(bus.Request(bus.FUNCTION, 0x30, b'%d' % number)).data
                   == (b'%d' % number)[::-1] for number in range(base, base + 20))

    callers = [Waiter(call, base) for base in (1000, 2000, 3000)]
    assert all(caller.result() for caller in callers)
    assert len(board.moves()) == len(set(board.moves())) == 60


@pytest.mark.parametrize('request_, is_slow', [
    (LIFT, True), (bus.gimbal(0, 1), True), (bus.Request(bus.FUNCTION, 0x30), False),
    (bus.ENVIRONMENT_REQUEST, False), (bus.Request(0x0C, bus.LIFT), False)], ids=str)
def test_only_lift_and_gimbal_have_the_motion_timeout(board, open_link, request_, is_slow):
    """In a call of its own and in a raw request."""
    board.rule = lambda request: b'' if request == request_ else None
    settings = PATIENT._replace(reply_timeout=0.11, motion_timeout=0.22)
    outcome = open_link(settings).request(request_)
    assert outcome.status == TIMEOUT
    assert outcome.message.startswith('no reply within %g s:' % (0.22 if is_slow else 0.11))


def test_a_damaged_reply_is_reported_as_a_timeout_at_once(board, open_link):
    board.rule = lambda request: b'\xa5\0\2\0' if is_move(request) else None
    link = open_link()       # its timeouts are longer than this test may last
    outcome = link.lift(0, 100)
    assert outcome.status == TIMEOUT and 'damaged' in outcome.message
    assert board.moves() == [LIFT]
    until(lambda: link.master.in_step)
    assert dict(link.report(0).values)['checksum errors'] == 1


def test_invalid_arguments_are_refused_without_sending(board, open_link):
    link = open_link()
    for outcome, said in ((link.lift(2, 10), 'lift: direction is 2'),
                          (link.gimbal(0, 256), 'angle is 256'),
                          (link.request(bus.Request(1, 0, bytes(1025))), '1025')):
        assert outcome.status == NOT_SENT and said in outcome.message
        assert 'nothing was sent' in outcome.message
    assert board.executed == []


# -- the port goes and comes ----------------------------------------------------------------------

def test_a_closed_port_refuses_at_once(line, logger, running):
    link = running(BusLink(Port(line.path + '.absent'), PATIENT, logger=logger))
    for outcome in (link.lift(0, 1), echo(link), link.environment()[0]):
        assert outcome.status == NOT_SENT and 'closed' in outcome.message
    assert link.report(time.monotonic()).level == ERROR


def test_the_outcome_is_unknown_if_the_port_closes_during_a_motion(board, open_link):
    board.rule = lambda request: b'' if is_move(request) else None
    link = open_link()
    moving = Waiter(link.lift, 0, 100)
    until(board.moves)
    waiting = Waiter(link.gimbal, 0, 1)
    until(lambda: list(link.master.calls))
    with board.unplugged():
        assert moving.result().status == TIMEOUT
        assert waiting.result().status == NOT_SENT
        assert link.lift(0, 100).status == NOT_SENT
    board.rule = lambda request: None
    until(lambda: link.master.synchronised and link.master.in_step)
    assert link.connection.reconnects == 1
    assert echo(link).success
    assert board.moves() == [LIFT], 'something of before went out after the reconnect'
    assert link.lift(0, 100).success


def test_stopping_ends_waiting_calls(board, open_link):
    board.rule = lambda request: b'' if is_move(request) else None
    link = open_link()
    moving = Waiter(link.lift, 0, 100)
    until(board.moves)
    link.stop()
    link.join(PATIENCE)
    assert moving.result().status == TIMEOUT
    assert not link.port.is_open
    assert link.lift(0, 1).status == NOT_SENT


def test_a_caller_waits_for_all_tries_though_the_first_has_begun(board, open_link, monkeypatch):
    link = open_link(SHORT._replace(retries=0))
    wake, waits = link.wake, []
    monkeypatch.setattr(link, 'wake', lambda: wake() or until(board.moves))
    monkeypatch.setattr(Call, 'wait', lambda call, seconds: waits.append(seconds))
    link.lift(0, 100)
    until(lambda: not link.master.calls.next())
    turn, one_try = NOT_READY_WAIT, SHORT.motion_timeout + NOT_READY_WAIT
    assert waits == [turn + one_try]


def test_a_board_that_is_silent_is_reported(line, logger, running, lines, monkeypatch):
    monkeypatch.setattr(link_module, 'STARTUP_TIME', 0.5)
    link = running(BusLink(Port(line.path), SHORT, logger=logger))
    until(lambda: link.report(time.monotonic()).level == ERROR
          and link.report(time.monotonic()).summary == 'the board does not answer SYNC')
    assert link.lift(0, 1).status == NOT_SENT
    until(lambda: lines('does not answer SYNC'))      # later: the board may still be booting
    assert len(lines('does not answer SYNC')) == 1


def no_echo(request):
    return b'' if request.cmd1 == bus.ECHO else None


def test_a_board_that_does_not_echo_is_an_error_that_names_the_parameter(board, open_link, lines):
    board.rule = no_echo
    link = open_link(SHORT, ready=False)
    until(lambda: link.report(time.monotonic())[:2] == (
        ERROR, 'the board does not answer ECHO (see bus/echo)'))
    outcome = link.lift(0, 100)
    assert outcome.status == NOT_SENT and 'bus/echo' in outcome.message
    assert len(lines('set bus/echo to false')) == 1 and board.executed == []
    board.rule = lambda request: None
    until(lambda: link.master.in_step)
    assert link.lift(0, 100).success


def test_a_board_that_knows_no_echo_is_served_without(board, open_link):
    board.rule = no_echo
    link = open_link(SHORT._replace(echo=False, motion_timeout=PATIENCE))
    assert link.lift(0, 100).success and link.gimbal(0, 1).success
    assert bus.ECHO not in [request.cmd1 for request in board.requests()]
    assert link.report(time.monotonic())[:2] == (OK, 'ready')


@pytest.mark.parametrize('condition, level, talks', [
    (Condition.READY, OK, True), (Condition.SYNCHRONISING, WARN, None),
    (Condition.OUT_OF_STEP, WARN, None), (Condition.NO_ECHO, ERROR, None),
    (Condition.NO_SYNC, ERROR, False)])
def test_each_condition_has_a_level_and_a_summary(board, open_link, monkeypatch, condition, level,
                                                  talks):
    link = open_link()
    monkeypatch.setattr(link.master, 'condition', lambda: condition)
    assert link.condition(0.0) == (level, condition.value or 'ready')
    assert link.talks(0.0) == talks


def test_a_blocked_port_is_tried_again_only_after_a_pause(line, logger, running):
    """Not ten thousand times a second."""
    class Stuck(Port):
        tries = 0

        def write(self, frame):
            self.tries += 1
            raise PortBusy('the port takes no data')

    port = Stuck(line.path)
    running(BusLink(port, SHORT, logger=logger))
    until(lambda: port.tries)
    before = port.tries
    time.sleep(0.3)
    assert port.tries - before < 100


def test_the_tap_sees_every_frame_both_ways(board, open_link):
    link = open_link()
    tapped = []
    link.tap = lambda name, direction, frame: tapped.append((name, direction, frame))
    board.rule = lambda request: b'\x11\x22' + OK_WIRE if is_move(request) else None
    link.lift(0, 100)
    until(lambda: link.master.in_step)
    until(lambda: len(tapped) >= 5)
    assert [(name, direction, str(frame.message or frame.cause))
            for name, direction, frame in tapped[:3]] == [
                ('bus', TX, 'lift up 100 mm'), ('bus', RX, 'framing'), ('bus', RX, 'OK')]
    assert tapped[0][2].raw == bus.encode_request(LIFT)


# -- what a request waits for ---------------------------------------------------------------------

STOP = bus.Request(bus.FUNCTION, 0x2F)
STOP_FUNCTION = bus.Function('stop', 0x2F, repeatable=True, interrupts=True)


def test_a_stop_is_sent_while_an_incomplete_frame_is_received(line, board, open_link):
    link = open_link(frame_timeout=60.0)
    line.write(b'\xa5\xf0')
    until(lambda: link.decoder.begun)
    caller = Waiter(link.request, STOP, STOP_FUNCTION)
    until(lambda: STOP in board.requests())
    link.stop()
    caller.result()


def test_a_stop_is_sent_while_bytes_are_received_without_a_pause(line, logger, monkeypatch):
    link = BusLink(Port(line.path), PATIENT, logger=logger)
    sent = []
    monkeypatch.setattr(link, 'send', lambda frame, cmd1, cmd2, data, request: sent.append(request))
    link.master.connected(10.0)
    link.connection.state = PortState.RECEIVING
    link.tick(10.0)
    assert sent == []
    link.master.submit(link._call(STOP, STOP_FUNCTION, None))
    link.tick(10.001)
    assert sent == [STOP]


def test_the_state_says_what_a_call_waits_for(line, board, open_link):
    link = open_link(SHORT, frame_timeout=60.0)
    line.write(b'\xa5\xf0')
    until(lambda: link.decoder.begun)
    outcome = link.lift(0, 100)
    assert outcome.status == NOT_SENT
    assert outcome.message == 'the link waits for the rest of an incomplete frame; nothing was sent'
    assert link.report(time.monotonic())[:2] == (
        WARN, 'open, waits for the rest of an incomplete frame')
    assert board.moves() == []


# -- a move never comes late ----------------------------------------------------------------------

def test_a_move_that_timed_out_is_dropped_where_it_waits(line, board, open_link):
    """The other side of a pseudo terminal takes nothing, from the reply to the fence on."""
    link = open_link(PATIENT._replace(motion_timeout=0.3))

    def stand(request):
        if request.cmd1 == bus.ECHO:
            link.port.write(bytes(8000))    # a flush does not reach what the other side can read
            board._closing.set()

    assert link.request(bus.Request(bus.FUNCTION, 0x30)).success    # so that the next has a fence
    board.rule = stand
    assert link.lift(0, 100).status == TIMEOUT
    waiting = line.read_all()
    assert waiting and bus.encode_request(LIFT) not in waiting


def test_a_move_that_timed_out_closes_a_network_connection(logger, running):
    with socket.socket() as server:
        server.bind(('127.0.0.1', 0))
        server.listen(1)
        server.settimeout(PATIENCE)
        link = running(BusLink(Port('socket://127.0.0.1:%d' % server.getsockname()[1]),
                               PATIENT._replace(retries=0), logger=logger))

        def call_within(seconds, call, *arguments):
            link.settings = link.settings._replace(reply_timeout=seconds, motion_timeout=seconds)
            return call(*arguments)

        with server.accept()[0] as peer:
            peer.setblocking(False)
            line = Pty('a connection')
            line.fd = peer.fileno()
            board = running(BusBoard(line))
            until(lambda: link.master.in_step)
            board.script.append(b'')
            assert call_within(0.15, link.environment)[0].status == TIMEOUT
            assert call_within(PATIENCE, link.lift, 0, 1).success
            assert link.connection.number == 1, 'it was a reading'
            board.script.append(b'\xa5')
            assert call_within(1.0, link.lift, 0, 2).status == TIMEOUT
            assert call_within(PATIENCE, link.lift, 0, 3).success
            assert link.connection.number == 1, 'the board was heard'
            board.script.append(b'')
            assert call_within(0.3, link.lift, 0, 100).status == TIMEOUT
            server.accept()[0].close()
            until(lambda: link.connection.reconnects)
            board.close()
