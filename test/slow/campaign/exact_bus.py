"""The bus, exactly: compares what each call returned with what the board did."""
import contextlib
import itertools
import math
import signal
import struct
import time
from typing import Any, Callable, ContextManager, List, NamedTuple, Optional, Sequence, Tuple

import rosgraph
import rospy

import by_definition as codec
from .boards import (ANNOUNCE, HALT, MEMORY, OK, PERIODS, PRESS, PRESS_TIMEOUT, PROBE, PUMP,
                     PUMP_ROWS, QUICK, QUICK_TIMEOUT, SWAP, TICK, Reaction, Request, reply_frame)
from .rig import (FENCED, MOTION_TIMEOUT, NOISE, POLLED_TOPICS, REPLY_TIMEOUT, UNTIL_PUBLISHED,
                  Rig)
from .robot import NODE, NOT_SENT, TIMEOUT, Outcome

Key = Tuple[int, bytes]     # CMD2 and DATE of a request
QUEUE_TIME = 0.8         # s that a call may wait for its turn, in addition to its timeout
_ROS_TIME = 0.2          # s that ROS may take for a call
_LATE = 0.1              # s after the timeout
SERVICES = 'lift', 'gimbal', 'bus/request', 'press'
_NO_ECHO = 'bus: the board answers SYNC but not ECHO'
_SYNC_REPEATED = 'bus: the board does not answer ECHO.*; SYNC is repeated'
_NO_ANNOUNCEMENT = 'bus: the board does not answer the question for its announcement'
_WRONG_CRC = 'bus: the CRC of the announcement does not match'
_ASKED_AGAIN = 0.5, 1.0, 2.0, 4.0, 8.0      # s after a question for the announcement was given up
_FUNCTIONS = {'lift': codec.LIFT, 'gimbal': codec.GIMBAL, 'press': PRESS}
_DIRECTIONS = {'lift': 2, 'gimbal': 4, 'press': 2}
_TIMEOUTS = {'lift': MOTION_TIMEOUT, 'gimbal': MOTION_TIMEOUT, 'press': PRESS_TIMEOUT,
             'bus/request': REPLY_TIMEOUT}


def _refusal(code: int, kind: int = codec.INVALID) -> bytes:
    return reply_frame(kind, struct.pack('<H' if code > 255 else '<B', code))


def _executed(*delays: float, before: bytes = b'') -> Reaction:
    """Executed; replied after each of these times, once with other bytes before the reply."""
    return Reaction([(0, before)][:len(before)] + [(delay, OK) for delay in delays], True)


def _replied(*replies: bytes) -> Reaction:
    """Not executed; replied at once, and then after 60 ms."""
    return Reaction([(0.06 * number, reply) for number, reply in enumerate(replies)])


class Case(NamedTuple):
    """How a board treats a request, and the correct result."""

    name: str
    reactions: Sequence[Reaction]    # to the first, second … time that it is received
    outcome: str                     # done, refused, not known or not sent
    received: int = 1                # how often the board receives the request
    # How it treats the first ECHO or SYNC (`probe_cmd`).
    probe: Any = None
    probe_cmd: int = codec.ECHO


_DONE, _LOST, _FAILED = _executed(0), Reaction(), _replied(_refusal(codec.FAILED, codec.ERROR))
_UNSYNCHRONISED = _replied(_refusal(codec.NOT_SYNCHRONISED)), _DONE
_DAMAGED = bytes((0xA5, 0, codec.OK ^ 0x10, 0xA5 ^ codec.OK))
_OTHER_FLAG = bytes((0xA4, 0, codec.OK, 0xA5 ^ codec.OK))
CASES = (
    Case('with a reply', [_DONE], 'done'),
    Case('with a reply after 200 bytes of noise', [_executed(0, before=NOISE)], 'done'),
    Case('failed', [_FAILED], 'refused'),
    Case('bad checksum, then a reply', [_replied(_refusal(codec.BAD_CHECKSUM)), _DONE], 'done', 2),
    Case('not synchronised, then a reply', _UNSYNCHRONISED, 'done', 2),
    Case('too long', [_replied(_refusal(0x20))], 'refused'),
    Case('executed without a reply', [_executed()], 'not known'),
    Case('lost request', [_LOST], 'not known'),
    Case('late reply', [_executed(MOTION_TIMEOUT + _LATE)], 'not known'),
    Case('damaged reply', [_executed(before=_DAMAGED)], 'not known'),
    Case('two replies at once', [_executed(0, 0)], 'done'),
    Case('two replies, 5 ms apart', [_executed(0, 0.005)], 'done'),
    Case('two replies, 40 ms apart', [_executed(0, 0.04)], 'done'))
# Tried with two services only: those of the session, which are the same for all. INVALID because of
# noise, and the request behind the noise is executed; replies to ECHO and SYNC that are wrong.
SESSION_CASES = (
    Case('bad checksum in two bytes, then a reply',
         [_replied(reply_frame(codec.INVALID, bytes((codec.BAD_CHECKSUM, 0)))), _DONE], 'done', 2),
    Case('with data in its reply', [Reaction([(0, reply_frame(codec.OK, b'1234'))], True)], 'done'),
    *(Case(f'INVALID {code:#x}, but executed', [_executed(0.01, before=_refusal(code)), _DONE],
           'not known') for code in (codec.BAD_CHECKSUM, codec.NOT_SYNCHRONISED, 0x20)),
    *(Case(f'an OK with another flag, then INVALID {code:#x}', [
        _executed(before=_OTHER_FLAG + _refusal(code)), _DONE],
           'not known') for code in (codec.BAD_CHECKSUM, codec.NOT_SYNCHRONISED, 0x20)),
    *(Case(f'INVALID {code:#x}, then an OK with another flag', [
        _executed(before=_refusal(code) + _OTHER_FLAG), _DONE], 'not known')
      for code in (codec.BAD_CHECKSUM, 0x20)),
    Case('bad checksum each time', [_replied(_refusal(codec.BAD_CHECKSUM))], 'refused', 3),
    Case('bad checksum, in two bytes', [
        _replied(reply_frame(codec.INVALID, bytes((codec.BAD_CHECKSUM, 0)))), _DONE], 'done', 2),
    *(Case(f'behind {what} {name}', reactions, 'done', len(reactions), probe, cmd)
      for name, cmd, reactions, other in (
          ('ECHO', codec.ECHO, [_DONE], reply_frame(codec.SYNC)),
          ('SYNC', codec.SYNC, _UNSYNCHRONISED, reply_frame(codec.ECHO, b'else')))
      for what, probe in (
          ('a late', Reaction([(0.2, OK)])), ('a lost', _LOST),
          ('a doubled', Reaction([(0, OK), (0, OK)])),
          ('a doubled and late', Reaction([(0, OK), (0.005, OK)])),
          ('a wrong reply to', _replied(other, OK)))),
    Case('behind a foreign ECHO', [_DONE], 'done', 1, lambda request: _replied(
        # Another nonce, in its last byte.
        reply_frame(codec.ECHO, request.data[:3] + bytes((request.data[3] ^ 1,))), OK)))


class Call(NamedTuple):
    """A call that was started."""

    service: str
    key: Key             # of its request
    result: Callable[[], Outcome]       # waits until it returns


class Calls:
    """Makes calls with unique numbers, and checks their outcomes."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.matches = rig.row('the outcome of a call matches what the board replied')
        self.own_reply = rig.row('no late or doubled reply is used for another request')
        self._numbers = itertools.count(1)

    def next_key(self, service: str) -> Key:
        """The key of the request of the next call."""
        n = next(self._numbers)
        if service == 'bus/request':
            return MEMORY, struct.pack('<I', n)
        return _FUNCTIONS[service], bytes((n % _DIRECTIONS[service], 255 - n // 2 % 256))

    def start(self, service: str, connected: Optional[rospy.ServiceProxy] = None) -> Call:
        """Start a call of a service, over a connection that there is already, if given."""
        key = self.next_key(service)
        arguments = (codec.FUNCTION, *key) if key[0] == MEMORY else key[1]
        return Call(service, key, self.rig.robot.start_call(connected or service, *arguments))

    def start_unanswered(self) -> Call:
        """Start a call of the lift, which is executed without a reply."""
        self.rig.bus.react = lambda request: _executed()
        call = self.start('lift')
        self.rig.wait(lambda: self.rig.bus.executed[call.key], 'it arrives')
        return call

    def call(self, service: str, what: str, wanted: str, limit: float = MOTION_TIMEOUT) -> Outcome:
        return self.check(self.start(service), what, wanted, limit)

    def check(self, call: Call, what: str, wanted: str, limit: float = MOTION_TIMEOUT) -> Outcome:
        """Compare what a call returns, within `limit`, with what the board did; `wanted` is one
        result or several."""
        outcome, key = call.result(), call.key
        executed = self.rig.bus.executed[key]
        what = f'{call.service} {what}'
        text = f'{what}: {outcome.status} "{outcome.message[:90]}", executed {executed} times'
        self.rig.in_time(self.rig.row('a call returns within timeout + 0.8 s + 0.2 s for ROS'),
                         outcome.began, outcome.ended, limit + QUEUE_TIME + _ROS_TIME, what)
        self.matches.check(outcome.name in wanted, f'{text}, expected "{wanted}"')
        outcome.check(self.rig.row, executed, text)
        self.matches.check(outcome.message and (not outcome.success or outcome.status == codec.OK),
                           f'{text}: status')
        if outcome.success:
            self.own_reply.check(key[0] != MEMORY or outcome.data == key[1], f'{what}: other data')
        elif outcome.name != 'not known':
            codes = (codec.FAILED, 0x20, codec.BAD_CHECKSUM) if outcome.name == 'refused' else (0,)
            self.matches.check(outcome.error_code in codes, f'{text}: code {outcome.error_code}')
            status = codec.ERROR if outcome.error_code == codec.FAILED else codec.INVALID
            self.matches.check(outcome.name != 'refused' or outcome.status == status, text)
        return outcome

    def check_received(self, key: Key, times: int, what: str, connection: int = 0) -> None:
        """Check how often the board has received this request since that connection."""
        received = sum(each.key == key and each.connection >= connection
                       for each in self.rig.bus.requests)
        self.rig.row('a motion is sent again only if it was not executed').check(
            received == times, f'{what}: received {received} times, not {times}')


def outcomes(rig: Rig) -> None:
    """Every service in every case; after each call one that the board refuses, which must fail."""
    calls = Calls(rig)
    for case, service in rig.tries(*itertools.product(CASES, SERVICES),
                                   *itertools.product(SESSION_CASES, ('lift', 'press'))):
        _try_case(calls, case, service)
    rig.settle()
    for service in 'lift', 'gimbal':
        outcome = rig.robot.call(service, _DIRECTIONS[service], 1)
        calls.matches.check(outcome.status == NOT_SENT and not rig.bus.executed,
                            f'{service} in a direction that it has not: {outcome}')
    rig.bus.react = lambda request: _FAILED
    outcome = rig.robot.call('probe')       # its type has no field for the status
    calls.matches.check(outcome.message.startswith(f'status {codec.ERROR} '), f'{outcome}')
    rig.settle()
    rig.bus.react = lambda request: _executed(before=_refusal(codec.BAD_CHECKSUM))
    rig.bus.probe = lambda request: _LOST if rig.bus.executed else None
    calls.call('lift', 'executed and INVALID, then no ECHO', 'not known')


def no_replies(rig: Rig) -> None:
    """Every service, executed without a reply."""
    own = rig.row('a call without a reply ends after the timeout of its function')
    calls = Calls(rig)
    with rig.counted(rig.row('the counters in /diagnostics are exact'), 'bus',
                     {'timeouts': len(SERVICES) + 2}):
        for service in rig.tries(*SERVICES):
            rig.bus.react = lambda request: _executed()
            outcome, timeout = calls.call(service, 'without a reply', 'not known'), \
                _TIMEOUTS[service]
            rig.in_time(own, outcome.began, outcome.ended, timeout + _ROS_TIME, service, timeout)
        rig.bus.react = lambda request: _executed()
        outcome = rig.robot.call('bus/request', codec.FUNCTION, codec.LIFT, b'\1\1')
        rig.in_time(own, outcome.began, outcome.ended, MOTION_TIMEOUT + _ROS_TIME, 'a raw lift',
                    MOTION_TIMEOUT)
        outcome = rig.robot.call('quick')
        rig.in_time(own, outcome.began, outcome.ended, QUICK_TIMEOUT + _ROS_TIME, 'quick',
                    QUICK_TIMEOUT)
        own.check(rig.bus.count(QUICK) == 1, 'quick was sent again')
        rig.bus.usual()


def _try_case(calls: Calls, case: Case, service: str) -> None:
    rig = calls.rig

    def react(request: Request) -> Reaction:
        if request.cmd2 == PROBE:
            return _FAILED
        times = [each.key for each in rig.bus.requests].count(request.key)
        return case.reactions[min(times, len(case.reactions)) - 1]

    def probe(request: Request) -> Any:
        is_first = [each.cmd1 for each in rig.bus.requests].count(request.cmd1) == 1
        if request.cmd1 != case.probe_cmd or not is_first:
            return None
        return case.probe(request) if callable(case.probe) else case.probe

    rig.bus.react, rig.bus.probe = react, probe
    call = calls.start(service)
    call.result()       # without a pause: late or doubled replies may still arrive
    second = rig.robot.call('probe')
    calls.check(call, case.name, case.outcome)
    calls.check_received(call.key, case.received, case.name)
    calls.own_reply.check(not second.success, f'{case.name}: a refused call returned success')


def readings(rig: Rig) -> None:
    """A request that reads is sent again, but its value is that of one reply; long data."""
    again = rig.row('a request that reads is sent again, and published once')
    for lost in rig.tries(*range(3)):
        rig.bus.react = lambda request: _LOST if rig.bus.count(codec.ENVIRONMENT) <= lost \
            else None
        outcome = rig.robot.call('get_environment')
        received = rig.bus.count(codec.ENVIRONMENT)
        again.check(outcome.success and received == lost + 1, f'{lost} lost: {outcome}')
        rig.compare(rig.bus)
        header = rig.robot.published['~environment'][-1].message.header
        again.check((header.stamp, header.frame_id) == (
            outcome.header.stamp, outcome.header.frame_id), f'{outcome.header}, not {header}')
        published = [each.key for each in rig.robot.published['~environment']]
        again.check([outcome.reading] == published, f'{outcome}, {published} published')
    rig.settle()
    rig.bus.react = lambda request: _LOST
    outcome = rig.robot.call('get_environment')
    received = rig.bus.count(codec.ENVIRONMENT)
    again.check(not outcome.success and received == 3, f'{received} lost: {outcome}')
    rig.settle()
    rig.bus.react = lambda request: _LOST
    outcome = rig.robot.call('bus/request', codec.FUNCTION, codec.ENVIRONMENT, b'')
    again.check((rig.bus.count(codec.ENVIRONMENT), outcome.status) == (1, TIMEOUT),
                f'a raw request that reads was sent again: {outcome}')
    rig.settle()
    with rig.counted(rig.row('the counters in /diagnostics are exact'), 'bus',
                     {'length errors': 1}) as began:
        rig.bus.react = lambda request: _replied(reply_frame(codec.OK, b'123'))
        outcome = rig.robot.call('get_environment')
        again.wait(lambda: rig.bus.requests[-1].cmd1 == codec.ECHO, 'a fence behind it')
        again.check((outcome.success, outcome.status) == (False, codec.OK),
                    f'a reply of three bytes: {outcome}')
        rig.diagnosed('bus', 1, 'in the last second', began)
    rig.settle()
    for _ in range(2):      # the second call is equal to the request before it
        rig.robot.call('lift', 0, 1)
    rig.settle()
    _call_session(rig)
    for size in (253, 254, 255, 256, 300, 1024):
        data = bytes(n % 255 + 1 for n in range(size))
        outcome = rig.robot.call('bus/request', codec.FUNCTION, MEMORY, data)
        rig.row('requests and replies with up to 1024 bytes arrive unchanged').check(
            outcome.data == data and rig.bus.executed[MEMORY, data] == 1,
            f'{size} bytes: {outcome.status}, {len(outcome.data)} bytes')


def functions(rig: Rig) -> None:
    """Custom functions: one with values, which may be sent again, and one without an outcome."""
    matches = rig.row('the outcome of a call matches what the board replied')
    for lost in rig.tries(0, 2, 3):
        rig.bus.react = lambda request: _LOST if rig.bus.count(SWAP) <= lost else None
        outcome, received = rig.robot.call('swap', 1, 2, b''), rig.bus.count(SWAP)
        data = b'\4\0\2' if lost < 3 else b''
        matches.check((outcome.success, outcome.data) == (lost < 3, data) and received
                      == min(lost + 1, 3), f'swap, {lost} lost, {received} received: {outcome}')
    for service, arguments in ('swap', (101, 2, b'')), ('bus/request', (0x55, MEMORY, bytes(1025))):
        rig.settle()
        outcome = rig.robot.call(service, *arguments)
        matches.check(outcome.status == NOT_SENT and not rig.bus.executed, f'{service}: {outcome}')
    matches.check(rig.robot.call('rest').success, 'rest failed')
    rig.bus.react = lambda request: _FAILED
    outcome = rig.robot.call('rest')
    matches.check(not outcome.success and f'status {codec.ERROR} ' in outcome.message,
                  f'a failed rest: {outcome}')


def _call_session(rig: Rig) -> None:
    """The services that send ECHO and SYNC; the one of ECHO tells how many ms the reply took."""
    required = rig.row('bus/sync sends SYNC; bus/echo tells how long ECHO took')
    outcome = rig.robot.call('bus/sync')
    sent = [each.cmd2 for each in rig.bus.requests if each.cmd1 == codec.SYNC]
    required.check(outcome.success and set(sent) == {0}, f'SYNC: {outcome}, sent with CMD2 {sent}')
    rig.bus.probe = lambda request: Reaction([(0.05, OK)])
    outcome = rig.robot.call('bus/echo')
    took = float(outcome.message.split()[0]) / 1e3
    required.check(0.049 < took < outcome.ended - outcome.began, f'ECHO: {outcome}')
    rig.bus.probe = None
    rig.wait_in_step()
    rig.next_report('bus')
    shown = rig.next_report('bus')[2]
    longest, usual = (float(shown[f'round trip {what} [ms]']) / 1e3 for what in ('max', 'p50'))
    required.check(longest > took - 1e-4 and usual < 0.04, f'{shown}')


Probe = Callable[[Request], Optional[Reaction]]


def reconnect(rig: Rig, probe: Optional[Probe] = None) -> None:
    """The port is closed and opened; then the board reacts so to SYNC and ECHO."""
    rig.bus_line.unplug()
    rig.bus.probe = probe
    rig.bus_line.plug()


def no_sync(request: Request) -> Optional[Reaction]:
    return _LOST if request.cmd1 == codec.SYNC else None


def no_echo(rig: Rig) -> None:
    """A board that answers SYNC but no ECHO, and then answers."""
    calls = Calls(rig)
    before = len(rig.logs.find(_NO_ECHO))
    reconnect(rig, lambda request: _LOST if request.cmd1 == codec.ECHO else None)
    rig.wait(lambda: sum(each.cmd1 == codec.ECHO for each in rig.bus.connection_requests) > 3,
             'ECHO is repeated', 10.0)
    calls.call('lift', 'without ECHO', 'not sent', 0.0)
    rig.diagnosed('bus', 2, 'does not answer ECHO')
    logged = rig.row('what happened is in the log')
    logged.wait(lambda: len(rig.logs.find(_NO_ECHO)) > before, 'it is logged', 10.0)
    logged.check(not rig.logs.find(_SYNC_REPEATED), 'a board without ECHO is called silent')
    rig.bus.probe = None
    rig.wait_in_step()
    calls.call('lift', 'after ECHO', 'done')
    rig.diagnosed('bus', 0, 'ready')


def never_echoes(rig: Rig) -> None:
    """bus/echo is false: silence is the fence."""
    quiet = rig.row('a board that never echoes: 20 ms of silence before each call')
    calls = Calls(rig)
    for index in range(8):
        written_at = rig.bus.written_at

        def react(request: Request) -> Reaction:
            if request.cmd2 == PROBE:
                return _FAILED
            quiet.check(request.t - written_at >= 0.019,
                        f'{request} came {request.t - written_at:.4f} s behind the last bytes')
            return _executed(0, 0.005)
        rig.bus.react = react
        calls.call(('lift', 'bus/request')[index % 2], 'without ECHO', 'done')
        calls.own_reply.check(not rig.robot.call('probe').success, 'another reply was used')
    with rig.counted(rig.row('the counters in /diagnostics are exact'), 'bus', {'timeouts': 1}):
        rig.bus.react = lambda request: _replied(reply_frame(codec.OK, b'1234'))
        calls.call('lift', 'without ECHO, OK with data', 'not known')
    for code in codec.BAD_CHECKSUM, 0x20:
        rig.bus.react = lambda request: _replied(_refusal(code))
        call = calls.start('lift')
        calls.check(call, 'without ECHO, INVALID', 'not known', 0.0)
        calls.check_received(call.key, 1, 'without ECHO, INVALID')
    quiet.check(codec.ECHO not in [each.cmd1 for each in rig.bus.requests], 'an ECHO')
    rig.bus.react = None


def unanswered_sync(rig: Rig) -> None:
    """A board that answers no SYNC, and then answers."""
    only = rig.row('until SYNC is answered nothing else is sent')
    calls = Calls(rig)
    reconnect(rig, no_sync)
    rig.wait(lambda: len(rig.bus.requests) > 2, 'SYNC is repeated')
    calls.call('lift', 'without SYNC', 'not sent', 0.0)
    rig.diagnosed('bus', 2, 'does not answer SYNC')
    rig.row('what happened is in the log').wait(
        lambda: rig.logs.find('bus: the board does not answer SYNC'), 'it is logged', 10.0)
    for request in list(rig.bus.requests):
        only.check(request.cmd1 == codec.SYNC, f'{request} was sent')
    rig.bus.probe = None
    rig.wait_in_step()
    calls.call('lift', 'after SYNC', 'done')
    rig.diagnosed('bus', 0, 'ready')
    rig.row('a function is sent only to the board that announced it').check(
        not rig.bus.count(ANNOUNCE), 'a question for an announcement')
    reconnect(rig)
    rig.wait(lambda: codec.ECHO in [each.cmd1 for each in rig.bus.connection_requests], 'a fence')
    rig.sleep(1.2)
    call = calls.start('lift')
    calls.check(call, 'long after a fence', 'done')
    requests = rig.bus.connection_requests
    keys = [each.key for each in requests]
    fence, lift = requests[keys.index(call.key) - 1:][:2]
    rig.in_time(rig.row(FENCED), fence.t, lift.t, 1.0, 'the age of the fence')


def queue(rig: Rig) -> None:
    """Eight callers at once, and a board that replies after 30 ms; then a board that is too slow
    for the queue."""
    required = rig.row('at most one request is outstanding')
    calls = Calls(rig)
    proxies = [rig.robot.connect('bus/request') for _ in range(8)]
    for delay, pause, wanted, least, most in rig.tries(
            (0.03, 0.0, 'done', 8, 8), (0.25, 0.1, 'done or not sent', 2, 7)):
        replied_at = [0.0]

        def react(request: Request) -> Reaction:
            required.check(request.t >= replied_at[-1], f'{request} arrived before the last reply')
            replied_at.append(request.t + delay)
            return _executed(delay)

        rig.bus.react = react
        made, done = [], 0
        for proxy in proxies:
            made.append(calls.start('bus/request', proxy))
            rig.sleep(pause)        # so that they arrive in this order
        for call in made:
            call.result()
        for call in made:
            success = calls.check(call, 'one of 8 at once', wanted, REPLY_TIMEOUT).success
            calls.check_received(call.key, success, 'one of 8 at once')
            done += success
        required.check(least <= done <= most, f'{done} of 8 calls done')
        keys = [call.key for call in made]
        sent = [keys.index(each.key) for each in rig.bus.requests if each.key in keys]
        required.check(not pause or sent == sorted(sent), f'the calls were sent as {sent}')


def interrupted(rig: Rig) -> None:
    """A stop, while a motion and calls behind it wait; also behind noise that never ends."""
    at_once = rig.row('a stop is sent within 50 ms, whatever is outstanding')
    calls, lift, halt = Calls(rig), rig.robot.connect('lift'), rig.robot.connect('halt')
    raw = rig.robot.connect('bus/request')
    for noise in rig.tries(False, False, True):
        outstanding = calls.start_unanswered()
        behind = calls.start('lift', lift), calls.start('bus/request', raw)
        rig.sleep(0.2)      # these calls have arrived, and the motion has not timed out
        with _dribble(rig) if noise else contextlib.nullcontext():
            # The board answers ECHO only after the motion.
            rig.bus.probe = lambda request: Reaction([(0.2, OK)])
            began = time.monotonic()
            stop = rig.robot.start_call(halt)
            at_once.wait(lambda: rig.bus.count(HALT), 'the stop arrives', 5.0)
            sent = next(each for each in rig.bus.requests if each.cmd2 == HALT)
            rig.in_time(at_once, began, sent.t, 0.05, f'noise: {noise}')
            rig.bus.react = rig.bus.probe = None
            calls.check(outstanding, 'interrupted', 'not known', 1.0)
            for each in behind:
                calls.check(each, 'behind a stop', 'not sent', 1.0)
        at_once.check(stop().success or noise, 'the stop failed')
    for _ in rig.tries(*range(2)):
        outstanding = calls.start_unanswered()
        rig.bus.probe = lambda request: _LOST
        stop = rig.robot.start_call('halt')
        rig.row('a stop is sent again while no ECHO returns').wait(
            lambda: rig.bus.count(HALT) > 1, 'it is sent again', 5.0)
        rig.bus.react = rig.bus.probe = None
        calls.check(outstanding, 'interrupted', 'not known', 1.0)
        stop()
    rig.settle()
    rig.bus.react = lambda request: None if request.cmd2 != HALT else \
        _DONE if rig.bus.count(HALT) < 2 else _replied(_refusal(0x20))
    outcome = rig.robot.call('halt')
    calls.matches.check(outcome.success or outcome.message.startswith(f'status {TIMEOUT} '),
                        f'a stop, executed and then refused: {outcome}')


def _dribble(rig: Rig) -> ContextManager[None]:
    """A false start, and then a byte each 30 ms."""
    rig.bus_line.write(b'\xA5\xF0')
    return rig.clock.each(0.03, lambda: rig.bus_line.write(b'\x11'))


def dribble(rig: Rig) -> None:
    """A false start and a byte each 30 ms, which could hold the link for seconds."""
    calls = Calls(rig)
    for _ in rig.tries(*range(3)):
        with _dribble(rig):
            rig.sleep(0.2)
            outcome = calls.call('bus/request', 'noise', 'done or not known', 0.3)
        rig.row('a false start is given up after its wire time, whatever comes').check(
            outcome.status != NOT_SENT, f'{outcome}')


def suspended_caller(rig: Rig) -> None:
    """SIGSTOP of a caller while the board executes its request; other callers are served."""
    required = rig.row('a suspended caller delays no other call; its outcome is true')
    calls = Calls(rig)
    for index in rig.tries(*range(3)):
        key = calls.next_key('lift')
        rig.bus.react = lambda request: _executed(0.05)
        child = rig.child(f'suspended_caller_{index}', [
            'rosservice', 'call', f'{NODE}/lift', *map(str, key[1])])
        required.wait(lambda: rig.bus.executed[key], 'the request arrives')
        child.hold()
        for _ in range(3):
            calls.call('bus/request', 'of another caller', 'done')
        child.send(signal.SIGCONT)
        required.wait(lambda: not child.alive, 'the call returns')
        required.check('success: True' in child.tail() and rig.bus.executed[key] == 1,
                       f'{child.tail()}, executed {rig.bus.executed[key]} times')
        rig.end(child)


def announced(rig: Rig) -> None:
    """A board announces a function; another one, which announces nothing, takes its place."""
    required = rig.row('a function is sent only to the board that announced it')
    calls = Calls(rig)
    chunks = codec.announcement(PUMP_ROWS, 30)
    _ignored(rig, chunks)
    for same_port in rig.tries(True, False):
        rig.bus.announces = chunks
        reconnect(rig)
        question = required.wait(lambda: [
            each for each in rig.bus.connection_requests if each.cmd2 == ANNOUNCE],
            'it is asked')[0]
        sync = rig.bus.connection_requests[0]
        rig.in_time(required, sync.t, question.t, 0.4, 'asked without a pause')
        required.wait(lambda: rig.robot.call('pump').success, 'pump is served', 10.0)
        asked = rig.bus.count(ANNOUNCE)
        rig.robot.call('bus/sync')
        required.wait(lambda: rig.bus.count(ANNOUNCE) >= asked + len(chunks), 'asked again', 5.0)
        required.wait(lambda: rig.robot.call('pump').success, 'pump is served again', 10.0)
        required.wait(lambda: rig.bus.count(TICK) > 2, 'tick is polled')
        rig.bus.announces, executed = [], rig.bus.executed[PUMP, b'']
        if same_port:
            rig.bus.react = lambda request: _executed(0.3)
            lift = calls.start('lift')
            rig.wait(lambda: rig.bus.executed[lift.key], 'it arrives')
            waiting = rig.robot.start_call('pump')
            rig.sleep(0.1)
            rig.bus.in_step, rig.bus.react = False, None
            calls.check(lift, 'of the board before', 'done')
            required.check(not waiting().success, 'a call that waited was done')
        else:
            reconnect(rig)
        for _ in range(2):      # at once, and when the board is known to announce nothing
            outcome = rig.robot.call('pump')
            required.check(rig.bus.executed[PUMP, b''] == executed and not outcome.success,
                           f'the other board executed it: {outcome}')
            rig.wait_in_step()
        required.wait(lambda: f'{NODE}/pump' not in _services(), 'pump is gone', 10.0)
        required.check(same_port or TICK not in [
            each.cmd2 for each in rig.bus.connection_requests],
            'tick was polled before it was announced')
        count = rig.bus.count(TICK)
        rig.sleep(0.3)
        required.check(rig.bus.count(TICK) == count, 'tick is polled at the other board')


def _ignored(rig: Rig, chunks: List[bytes]) -> None:
    """A text whose CRC is wrong is read three times. A question without an answer is asked again
    five times, later and later; each is sent three times."""
    required = rig.row('a function is sent only to the board that announced it')
    logged = rig.row('what happened is in the log')
    rig.settle()
    rig.bus.announces = codec.with_wrong_crc(chunks)
    reconnect(rig)
    logged.wait(lambda: rig.logs.find(_WRONG_CRC), 'a wrong CRC', 10.0)
    required.check(rig.bus.count(ANNOUNCE) == 3 * len(chunks),
                   f'{rig.bus.count(ANNOUNCE)} questions to a board with a wrong CRC')
    rig.wait_in_step()
    required.check(f'{NODE}/pump' not in _services(), 'a text with a wrong CRC is used')
    rig.settle()
    rig.bus.lost_questions = 3 * (1 + len(_ASKED_AGAIN))
    reconnect(rig)
    required.wait(lambda: not rig.bus.lost_questions, 'it is asked again', 40.0)
    asked = [each.t for each in rig.bus.requests if each.cmd2 == ANNOUNCE]
    for pause, before, again in zip(_ASKED_AGAIN, asked[2::3], asked[3::3]):
        rig.in_time(required, before, again, pause + REPLY_TIMEOUT + 0.3, 'asked again', pause)
    logged.wait(lambda: rig.logs.find(_NO_ANNOUNCEMENT), 'that it does not answer', 10.0)


def _services() -> List[str]:
    """All that the master knows."""
    return [name for name, _nodes in rosgraph.Master('/campaign').getSystemState()[2]]


def polls(rig: Rig) -> None:
    """Two polled functions with equally long replies, and the environment; all replies doubled."""
    required = rig.row('every polled value is from a reply to that function')
    for delay in (0.0, 0.005, 0.04):
        rig.robot.clear_records()
        rig.bus.react = lambda request: _executed(0, delay)
        for topic in POLLED_TOPICS:
            required.wait(lambda: len(rig.robot.published[topic]) >= 5, f'{topic} is polled')
    _check_turns(rig)
    for topic in POLLED_TOPICS:
        sent = {each.key: each.wall for each in rig.bus.sent if each.topic == topic}
        for message in list(rig.robot.published[topic]):
            if required.check(message.key in sent, f'{topic}: {message.key}, which was not sent'):
                rig.check_stamp(sent[message.key], message, topic)


def _check_turns(rig: Rig) -> None:
    """Polls that fail, and polls that take so long that one always waits; then each in time."""
    required = rig.row('polls go on in their period, and calls go before them')
    for reaction in _FAILED, _replied(_refusal(0x20)), _replied(_refusal(codec.BAD_CHECKSUM)):
        rig.bus.react = lambda request: reaction
        count = len(rig.bus.requests)
        required.wait(lambda: all(
            [each.cmd2 for each in rig.bus.requests[count:]].count(cmd2) > 3 for cmd2 in PERIODS),
            'polls that fail')
    rig.bus.react = lambda request: _executed(0.15)
    for _ in range(3):
        outcome = rig.robot.call('bus/request', codec.FUNCTION, MEMORY, b'1')
        required.check(outcome.success, f'behind polls: {outcome}')
    rig.bus.react = lambda request: _executed(0.4) if request.cmd2 == codec.LIFT else None
    required.check(rig.robot.call('lift', 0, 3).success, 'a lift among polls')
    rig.sleep(0.5)
    at = [each.cmd2 for each in rig.bus.requests].index(codec.LIFT)
    for cmd2, period in PERIODS.items():
        behind = [each.t for each in rig.bus.requests[at:] if each.cmd2 == cmd2][:4]
        rig.in_time(required, behind[0], behind[-1], math.inf, 'polls behind a lift', period)
    rig.bus.react = None
    for cmd2, period in PERIODS.items():
        since = len(rig.bus.requests)

        def times() -> List[float]:
            return [each.t for each in rig.bus.requests[since:] if each.cmd2 == cmd2]
        required.wait(lambda: len(times()) > 10, f'polls of {cmd2:#x}')
        rig.in_time(required, times()[0], times()[10], 12 * period, f'ten polls of {cmd2:#x}')


def one_poll(rig: Rig) -> None:
    """The environment is the only poll, and its request has a Datelen of 0."""
    required = rig.row('polls go on in their period, and calls go before them')
    frames: List[bytes] = []
    subscriber = rig.robot.subscribe_to_traffic(lambda frame: frames.append(bytes(frame.frame)))
    required.wait(lambda: rig.bus.count(codec.ENVIRONMENT) > 1, 'it is polled')
    since = rig.bus.count(codec.ENVIRONMENT)
    rig.bus.react = lambda request: _replied(reply_frame(codec.OK, b'123')) \
        if rig.bus.count(codec.ENVIRONMENT) == since + 1 else None
    required.wait(lambda: rig.bus.count(codec.ENVIRONMENT) > since + 1, 'it is polled again')
    at = [each.t for each in rig.bus.requests if each.cmd2 == codec.ENVIRONMENT]
    # A poll without a fence gets it, and is sent again.
    rig.in_time(required, at[since], at[since + 1], 0.5, 'again, behind a reply of three bytes')
    required.wait(lambda: b'\xA5\0\x55\x22\xD2' in frames, 'a Datelen of 0', UNTIL_PUBLISHED)
    subscriber.unregister()


ONE_POLL = {'bus/environment_period': 1.0, 'bus/environment_datelen': 0}
SERIAL = (outcomes, no_replies, readings, functions, queue, no_echo, unanswered_sync,
          interrupted, dribble, suspended_caller)
