"""The bus, exactly: compares what each call returned with what the board did."""
import contextlib
import itertools
import signal
import struct
import time
from concurrent.futures import Future
from typing import Callable, ContextManager, List, NamedTuple, Optional, Tuple

import by_definition as codec
from .boards import HALT, MEMORY, PRESS, PROBE, PUMP, PUMP_ROW, Reaction, Request, reply_frame
from .requirements import MAX_WAIT
from .rig import (MOTION_TIMEOUT, POLLED_TOPICS, PORT_RETURN, PORT_RETURNS, REPLY_TIMEOUT, Rig)
from .robot import NOT_SENT, Outcome

Key = Tuple[int, bytes]     # CMD2 and DATE of a request
QUEUE_TIME = 0.8         # s that a call may wait for its turn, in addition to its timeout
_ROS_TIME = 0.2          # s that ROS may take for a call
_LATE = 0.1              # s after the timeout


class Case(NamedTuple):
    """How a board treats a request, and the correct result."""

    name: str
    react: Callable[[Rig, Request, int], Reaction]   # int: how often the request was received
    outcome: str             # done, refused, not known or not sent
    received: int            # how often the board receives the request
    # How it treats the first ECHOs and SYNCs: the usual reply, and how often that was received.
    probe: Callable[[bytes, int], Optional[Reaction]] = lambda reply, n: None
    probe_cmd: int = codec.ECHO


def _ok(rig: Rig, request: Request, *delays: float) -> Reaction:
    return Reaction([(delay, rig.bus.ok_reply(request)) for delay in delays], True)


def _refusal(code: int, kind: int = codec.INVALID) -> Reaction:
    return Reaction([(0, reply_frame(kind, struct.pack('<H' if code > 255 else '<B', code)))])


_FAILED = _refusal(codec.FAILED, codec.ERROR)


def _damaged(rig: Rig, request: Request) -> Reaction:
    frame = bytearray(rig.bus.ok_reply(request))
    frame[2] ^= 0x10
    return Reaction([(0, bytes(frame))], True)


def _executed(rig: Rig, request: Request, *_n: int) -> Reaction:
    return _ok(rig, request, 0)


def _invalid_then(code: int) -> Callable[[Rig, Request, int], Reaction]:
    """INVALID because of noise, and the request behind the noise is executed."""
    return lambda rig, r, n: _ok(rig, r, 0) if n > 1 else Reaction(
        [*_refusal(code).replies, (0.01, rig.bus.ok_reply(r))], True)


def _once(reaction: Callable[[bytes], Reaction]) -> Callable[[bytes, int], Optional[Reaction]]:
    return lambda reply, n: reaction(reply) if n == 1 else None


def _foreign(reply: bytes) -> Reaction:
    """An ECHO with another nonce, in its last byte, and a while later the right one."""
    other = reply_frame(codec.ECHO, reply[3:6] + bytes((reply[6] ^ 1,)))
    return Reaction([(0, other), (0.06, reply)])


def _lost_synchronism(rig: Rig, request: Request, n: int) -> Reaction:
    return _refusal(codec.NOT_SYNCHRONISED) if n == 1 else _ok(rig, request, 0)


NOISE = bytes(byte for byte in range(256) if byte not in b'\xA5\x5A\x02\x00')[:200]
CASES = (
    Case('with a reply', _executed, 'done', 1),
    Case('with a reply after 200 bytes of noise', lambda rig, r, n: Reaction(
        [(0, NOISE + rig.bus.ok_reply(r))], True), 'done', 1),
    Case('failed', lambda rig, r, n: _FAILED, 'refused', 1),
    Case('bad checksum, then a reply', lambda rig, r, n: _refusal(codec.BAD_CHECKSUM)
         if n == 1 else _ok(rig, r, 0), 'done', 2),
    Case('not synchronised, then a reply', _lost_synchronism, 'done', 2),
    Case('too long', lambda rig, r, n: _refusal(0x20), 'refused', 1),
    Case('executed without a reply', lambda rig, r, n: Reaction([], True), 'not known', 1),
    Case('lost request', lambda rig, r, n: Reaction(), 'not known', 1),
    Case('late reply', lambda rig, r, n: _ok(rig, r, MOTION_TIMEOUT + _LATE), 'not known', 1),
    Case('damaged reply', lambda rig, r, n: _damaged(rig, r), 'not known', 1),
    Case('two replies at once', lambda rig, r, n: _ok(rig, r, 0, 0), 'done', 1),
    Case('two replies, 5 ms apart', lambda rig, r, n: _ok(rig, r, 0, 0.005), 'done', 1),
    Case('two replies, 40 ms apart', lambda rig, r, n: _ok(rig, r, 0, 0.04), 'done', 1))
# Tried with two services only: those of the session, which are the same for all.
SESSION_CASES = (
    Case('bad checksum, but executed', _invalid_then(codec.BAD_CHECKSUM), 'not known', 1),
    Case('not synchronised, but executed', _invalid_then(codec.NOT_SYNCHRONISED), 'not known', 1),
    Case('too long, but executed', _invalid_then(0x20), 'not known', 1),
    Case('bad checksum each time', lambda rig, r, n: _refusal(codec.BAD_CHECKSUM), 'refused', 3),
    Case('behind a late ECHO', _executed, 'done', 1, _once(lambda r: Reaction([(0.2, r)]))),
    Case('behind a lost ECHO', _executed, 'done', 1, _once(lambda r: Reaction())),
    Case('behind a doubled ECHO', _executed, 'done', 1, _once(lambda r: Reaction([(0, r + r)]))),
    Case('behind a foreign ECHO', _executed, 'done', 1, _once(_foreign)),
    Case('behind a SYNC reply to an ECHO', _executed, 'done', 1,
         _once(lambda r: Reaction([(0, reply_frame(codec.SYNC)), (0.06, r)]))),
    Case('behind a late SYNC', _lost_synchronism, 'done', 2,
         _once(lambda r: Reaction([(0.2, r)])), codec.SYNC),
    Case('behind a lost SYNC', _lost_synchronism, 'done', 2,
         _once(lambda r: Reaction()), codec.SYNC),
    Case('behind a doubled SYNC', _lost_synchronism, 'done', 2,
         _once(lambda r: Reaction([(0, r), (0.005, r)])), codec.SYNC),
    Case('behind a foreign reply to SYNC', _lost_synchronism, 'done', 2,
         _once(lambda r: Reaction([(0, reply_frame(codec.ECHO, b'else')), (0.06, r)])), codec.SYNC))


SERVICES = 'lift', 'gimbal', 'bus/request', 'press'
_FUNCTIONS = {'lift': codec.LIFT, 'gimbal': codec.GIMBAL, 'press': PRESS}


class Call(NamedTuple):
    """A call that was started."""

    service: str
    key: Key             # of its request
    future: 'Future[Outcome]'

    def result(self) -> Outcome:
        """Wait until it returns."""
        return self.future.result(MAX_WAIT)


class Calls:
    """Makes calls with unique numbers, and checks their outcomes."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        refused = rig.row('outcome refused or not sent: not executed')
        self.outcomes = {'done': rig.row('outcome done: executed exactly once'),
                         'refused': refused, 'not sent': refused,
                         'not known': rig.row('outcome not known: executed at most once')}
        self.sent_again = rig.row('a motion is sent again only if it was not executed')
        self.matches = rig.row('the outcome of a call matches what the board replied')
        self.in_time = rig.row('a call returns within timeout + 0.8 s + 0.2 s for ROS')
        self.own_reply = rig.row('no late or doubled reply is used for another request')
        self._number = 0

    def next_key(self, service: str) -> Key:
        """The key of the request of the next call."""
        self._number = n = self._number + 1
        if service == 'bus/request':
            return MEMORY, struct.pack('<I', n)
        return _FUNCTIONS[service], bytes((n % 2, n // 2 % 256))

    def start(self, service: str) -> Call:
        key = self.next_key(service)
        arguments = (codec.FUNCTION, *key) if key[0] == MEMORY else key[1]
        return Call(service, key, self.rig.robot.start_call(service, *arguments))

    def start_unanswered(self) -> Call:
        """Start a call of the lift, which is executed without a reply."""
        self.rig.bus.react = lambda request: Reaction([], True)
        call = self.start('lift')
        self.outcomes['not known'].wait(lambda: self.rig.bus.executed[call.key], 'it arrives')
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
        self.in_time.at_most(outcome.seconds, limit + QUEUE_TIME + _ROS_TIME, 's', what)
        self.matches.check(outcome.name in wanted, f'{text}, expected "{wanted}"')
        self.outcomes[outcome.name].check(outcome.is_true(executed), text)
        if outcome.success:
            self.own_reply.check(key[0] != MEMORY or outcome.data == key[1], f'{what}: other data')
        elif outcome.name != 'not known':
            codes = (codec.FAILED, 0x20, codec.BAD_CHECKSUM) if outcome.name == 'refused' else (0,)
            self.matches.check(outcome.error_code in codes, f'{text}: code {outcome.error_code}')
        return outcome

    def check_received(self, key: Key, times: int, what: str, connection: int = 0) -> None:
        """Check how often the board has received this request since that connection."""
        received = sum(each.key == key and each.connection >= connection
                       for each in self.rig.bus.requests)
        self.sent_again.check(received == times, f'{what}: received {received} times, not {times}')


def outcomes(rig: Rig) -> None:
    """Every service in every case; after each call one that the board refuses, which must fail."""
    calls = Calls(rig)
    for cases, services in ((CASES, SERVICES), (SESSION_CASES, ('lift', 'press'))):
        for case, service in itertools.product(cases, services):
            _try_case(calls, case, service)


def _try_case(calls: Calls, case: Case, service: str) -> None:
    rig = calls.rig
    rig.settle()

    def react(request: Request) -> Reaction:
        if request.cmd2 == PROBE:
            return _refusal(codec.FAILED, codec.ERROR)
        times = [each.key for each in rig.bus.requests].count(request.key)
        return case.react(rig, request, times)

    def probe(request: Request, reply: bytes) -> Optional[Reaction]:
        if request.cmd1 != case.probe_cmd:
            return None
        return case.probe(reply, [each.cmd1 for each in rig.bus.requests].count(request.cmd1))

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
    long = rig.row('requests and replies with up to 1024 bytes arrive unchanged')
    for lost in range(3):
        rig.settle()
        rig.bus.react = lambda request: Reaction() if len(received()) <= lost else None

        def received() -> List[Request]:
            return [each for each in rig.bus.requests if each.cmd2 == codec.ENVIRONMENT]
        outcome = rig.robot.call('get_environment')
        again.check(outcome.success and len(received()) == lost + 1, f'{lost} lost: {outcome}')
        rig.compare(rig.bus)
        published = [each.key for each in rig.robot.published['~environment']]
        again.check([outcome.reading] == published, f'{outcome}, {published} published')
    rig.settle()
    for size in (253, 254, 255, 256, 300, 1024):
        data = bytes(n % 255 + 1 for n in range(size))
        outcome = rig.robot.call('bus/request', codec.FUNCTION, MEMORY, data)
        long.check(outcome.data == data and rig.bus.executed[MEMORY, data] == 1,
                   f'{size} bytes: {outcome.status}, {len(outcome.data)} bytes')


def never_echoes(rig: Rig) -> None:
    """A board that answers no ECHO: silence is the fence."""
    quiet = rig.row('a board that never echoes: 20 ms of silence before each call')
    calls = Calls(rig)
    rig.settle()
    rig.bus_line.unplug()
    rig.bus.probe = lambda request, reply: Reaction() if request.cmd1 == codec.ECHO else None
    rig.bus_line.plug()
    quiet.wait(lambda: rig.robot.call('probe').success, 'calls are possible')
    for index in range(8):
        written = [0.0]

        def react(request: Request) -> Reaction:
            quiet.check(request.t - written[0] >= 0.019 or request.cmd2 == PROBE,
                        f'{request} came {request.t - written[0]:.4f} s behind the last bytes')
            return _FAILED if request.cmd2 == PROBE else _ok(rig, request, 0, 0.005)
        written[0] = rig.bus.written_at
        rig.bus.react = react
        calls.call(('lift', 'bus/request')[index % 2], 'without ECHO', 'done')
        calls.own_reply.check(not rig.robot.call('probe').success, 'another reply was used')
    rig.bus.react = lambda request: Reaction([(0, reply_frame(codec.OK, b'1234'))], True)
    calls.call('lift', 'without ECHO, OK with data', 'not known')
    rig.bus.faults.clear()
    rig.bus_line.unplug()
    rig.bus.usual()
    rig.bus_line.plug()


def unanswered_sync(rig: Rig) -> None:
    """A board that answers no SYNC, and then answers."""
    only = rig.row('until SYNC is answered nothing else is sent')
    calls = Calls(rig)
    rig.settle()
    rig.bus_line.unplug()
    rig.bus.probe = lambda request, reply: Reaction() if request.cmd1 == codec.SYNC else None
    rig.bus_line.plug()
    rig.wait(lambda: len(rig.bus.requests) > 2, 'SYNC is repeated')
    calls.call('lift', 'without SYNC', 'not sent', 0.0)
    rig.diagnosed('bus', 2, 'does not answer SYNC')
    for request in list(rig.bus.requests):
        only.check(request.cmd1 == codec.SYNC, f'{request} was sent')
    rig.bus.probe = None
    rig.wait_in_step()
    calls.call('lift', 'after SYNC', 'done')
    rig.diagnosed('bus', 0, 'ready')


def queue(rig: Rig) -> None:
    """Eight callers at once, and a board that replies after 30 ms; then a board that is too slow
    for the queue."""
    required = rig.row('at most one request is outstanding')
    calls = Calls(rig)
    for delay in 0.03, 0.25:
        rig.settle()
        replied_at = [0.0]

        def react(request: Request) -> Reaction:
            required.check(request.t >= replied_at[-1], f'{request} arrived before the last reply')
            replied_at.append(request.t + delay)
            return _ok(rig, request, delay)

        rig.bus.react = react
        made, done = [calls.start('bus/request') for _ in range(8)], 0
        wanted, least, most = ('done', 8, 8) if delay < 0.1 else ('done or not sent', 2, 7)
        for call in made:
            call.result()
        for call in made:
            success = calls.check(call, 'one of 8 at once', wanted, REPLY_TIMEOUT).success
            calls.check_received(call.key, success, 'one of 8 at once')
            done += success
        required.check(least <= done <= most, f'{done} of 8 calls done')


def interrupted(rig: Rig) -> None:
    """A stop, while a motion and calls behind it wait; also behind noise that never ends."""
    at_once = rig.row('a stop is sent within 50 ms, whatever is outstanding')
    calls = Calls(rig)
    for dribble in (False, False, True):
        rig.settle()
        outstanding, behind = calls.start_unanswered(), calls.start('lift')
        rig.sleep(0.1)
        with _dribble(rig) if dribble else contextlib.nullcontext():
            # The board answers ECHO only after the motion.
            rig.bus.probe = lambda request, reply: Reaction([(0.2, reply)])
            began = time.monotonic()
            stop = rig.robot.start_call('halt')
            sent = at_once.wait(lambda: [each for each in rig.bus.requests if each.cmd2 == HALT],
                                'the stop arrives', 5.0)[0]
            rig.in_time(at_once, began, sent.t, 0.05, f'noise: {dribble}')
            rig.bus.react = rig.bus.probe = None
            calls.check(outstanding, 'interrupted', 'not known', 1.0)
            calls.check(behind, 'behind a stop', 'not sent', 1.0)
        at_once.check(stop.result(MAX_WAIT).success or dribble, 'the stop failed')
        rig.bus.faults.clear()      # a stop has no fence


def _dribble(rig: Rig) -> ContextManager[None]:
    """A false start, and then a byte each 30 ms."""
    rig.bus_line.write(b'\xA5\xF0')
    return rig.clock.each(0.03, lambda: rig.bus_line.write(b'\x11'))


def dribble(rig: Rig) -> None:
    """A false start and a byte each 30 ms, which could hold the link for seconds."""
    calls = Calls(rig)
    required = rig.row('a false start is given up after its wire time, whatever comes')
    for _ in range(3):
        rig.settle()
        with _dribble(rig):
            rig.sleep(0.2)
            outcome = calls.call('bus/request', 'noise', 'done or not known', 0.3)
        required.check(outcome.status != NOT_SENT, f'{outcome}')


def frozen(rig: Rig) -> None:
    """The board reads no more, after the fence of a call; the call times out."""
    required = rig.row('a call that timed out unheard does not arrive later')
    calls = Calls(rig)
    for _ in range(2):
        rig.settle()

        def probe(request: Request, reply: bytes) -> Reaction:
            rig.bus.write(reply)
            rig.bus_line.hang()
            return Reaction()
        rig.bus.probe = probe
        call = calls.start('lift')
        call.result()
        rig.bus.probe = None
        rig.sleep(0.5)
        rig.bus_line.thaw()
        rig.wait_in_step()
        calls.check(call, 'frozen', 'not known')
        required.check(not rig.bus.executed[call.key], 'the lift moved after its call had returned')
        rig.bus.faults.clear()      # the fence was answered in another order than it was read


def suspended_caller(rig: Rig) -> None:
    """SIGSTOP of a caller while the board executes its request; other callers are served."""
    required = rig.row('a suspended caller delays no other call; its outcome is true')
    calls = Calls(rig)
    child = rig.user('caller', 'suspended_caller')
    for index in range(3):
        rig.settle()
        key = calls.next_key('lift')
        rig.bus.react = lambda request: _ok(rig, request, 0.05)
        child.order('%d %d' % tuple(key[1]))
        required.wait(lambda: rig.bus.executed[key], 'the request arrives')
        child.hold()
        for _ in range(3):
            calls.call('bus/request', 'of another caller', 'done')
        child.send(signal.SIGCONT)
        required.wait(lambda: child.tail().count('returned True') > index, 'the call returns')
        required.check(rig.bus.executed[key] == 1, f'executed {rig.bus.executed[key]} times')
    rig.end(child)


def unplugged_during_call(rig: Rig) -> None:
    """The port disappears before the reply; calls while it is absent, and afterwards."""
    calls, returns = Calls(rig), rig.row(PORT_RETURNS)
    sync = rig.row('after a reconnect the first request is SYNC')
    for index in range(3):
        rig.settle()
        outstanding = calls.start_unanswered()
        rig.bus_line.unplug()
        calls.check(outstanding, 'unplugged', 'not known')
        absent = calls.start('lift')
        calls.check(absent, 'while unplugged', 'not sent', QUEUE_TIME)
        rig.diagnosed('bus', 2, 'closed')
        connection, rig.bus.react = rig.bus.connection, None
        began, count = time.monotonic(), len(rig.bus.requests)
        rig.bus_line.plug(another_name=bool(index % 2))
        rig.wait(lambda: len(rig.bus.requests) > count, 'the port is opened again')
        first = rig.bus.requests[count]
        returns.at_most(first.t - began, PORT_RETURN, 's', 'bus')
        sync.check(first.cmd1 == codec.SYNC, f'the first request was {first}')
        calls.call('lift', 'after a reconnect', 'done')
        for call in (outstanding, absent):
            calls.check_received(call.key, 0, 'from before the reconnect', connection)


def suspended_bridge(rig: Rig) -> None:
    """SIGSTOP of the bridge while it waits for a reply, which arrives meanwhile, so it is stale;
    and calls from that time."""
    calls = Calls(rig)
    old = rig.row('a call from the time of a stall, or 0.5 s after it, is not sent')
    for seconds in (0.4, 0.7, 1.2):
        rig.settle()
        outstanding = calls.start_unanswered()
        with rig.suspended():
            rig.bus_line.write(reply_frame(codec.OK))
            made = [calls.start(service) for service in SERVICES]
            rig.sleep(seconds)
        rig.bus.react = None
        calls.check(outstanding, 'stall', 'not known', MOTION_TIMEOUT + seconds)
        for call in (*made, calls.start('lift')):
            outcome, executed = call.result(), rig.bus.executed[call.key]
            old.check(outcome.status == NOT_SENT and not executed,
                      f'{call.service}: {outcome}, executed {executed} times')
        rig.sleep(0.6)
        last = calls.start('lift')
        calls.check(last, 'after a stall', 'done')
        calls.check_received(last.key, 1, 'after a stall')


def announced(rig: Rig) -> None:
    """A board announces a function; another one, which announces nothing, takes its place."""
    required = rig.row('a function is sent only to the board that announced it')
    for index in range(2):
        rig.settle()
        rig.bus_line.unplug()
        rig.bus.announces = PUMP_ROW
        rig.bus_line.plug()
        required.wait(lambda: rig.robot.call('pump').success, 'the announced function is served')
        rig.bus.announces = b''
        if index:
            rig.bus_line.unplug()
            rig.bus_line.plug()
        else:
            rig.bus.in_step = False
            rig.robot.call('lift', 0, 3)
        rig.wait_in_step()
        executed = rig.bus.executed[PUMP, b'']
        outcome = rig.robot.call('pump')
        required.check(rig.bus.executed[PUMP, b''] == executed and not outcome.success,
                       f'the other board executed it: {outcome}')


def polls(rig: Rig) -> None:
    """Two polled functions with equally long replies, and the environment; all replies doubled."""
    required = rig.row('every polled value is from a reply to that function')
    for delay in (0.0, 0.005, 0.04):
        rig.robot.clear_records()
        rig.bus.react = lambda request: _ok(rig, request, 0, delay)
        for topic in POLLED_TOPICS:
            required.wait(lambda: len(rig.robot.published[topic]) >= 5, f'{topic} is polled')
    rig.bus.react = None
    for topic in POLLED_TOPICS:
        sent = {each.key: each.wall for each in rig.bus.sent if each.topic == topic}
        for message in list(rig.robot.published[topic]):
            required.check(message.key in sent, f'{topic}: {message.key}, which was not sent')
            if message.key in sent:
                rig.check_stamp(sent[message.key], message, topic)


SCENARIOS = (outcomes, readings, queue, never_echoes, unanswered_sync, interrupted, dribble,
             frozen, suspended_caller, unplugged_during_call, suspended_bridge)
