"""The bus, exactly: what each caller was told against what the board did.

Each call carries a number of its own, so a caller's answer is held against exactly one request. One
call is made at a time, and the line is quiet before it, unless the scenario says otherwise.
"""
import signal
import struct
import time
from concurrent.futures import Future
from typing import Callable, List, NamedTuple, Tuple

import by_definition as codec
from .boards import MEMORY, PRESS, Answer, Request, reply
from .field import BACK, MOTION_TIMEOUT, REPLY_TIMEOUT, RETURN, Field
from .robot import NOT_SENT, TIMEOUT, Told
from .rows import PATIENCE

Key = Tuple[int, bytes]     # CMD2 and DATE of a request
WAIT = 0.8               # s that a call may wait for its turn, beside the timeout of its own
_SLACK = 0.2             # s for ROS, the answer's way included
_LATE = 0.1              # s after the timeout


class Case(NamedTuple):
    """How a board treats a request, and what is true of it then."""

    name: str
    rule: Callable[[Field, Request, int], Answer]    # the number: how often it has been received
    told: str                # success, refused, timeout
    received: int


def _ok(field: Field, request: Request, *delays: float) -> Answer:
    return Answer([(delay, field.bus.ok(request)) for delay in delays], True)


def _refusal(code: int, kind: int = codec.INVALID) -> Answer:
    return Answer([(0, reply(kind, struct.pack('<H' if code > 255 else '<B', code)))])


def _damaged(field: Field, request: Request) -> Answer:
    frame = bytearray(field.bus.ok(request))
    frame[2] ^= 0x10
    return Answer([(0, bytes(frame))], True)


CASES = (
    Case('answered', lambda f, r, n: _ok(f, r, 0), 'success', 1),
    Case('answered behind noise', lambda f, r, n: Answer(
        [(0, b'\x00\x13' + f.bus.ok(r))], True), 'success', 1),
    Case('failed', lambda f, r, n: _refusal(codec.FAILED, codec.ERROR), 'refused', 1),
    Case('not understood, then answered', lambda f, r, n: _refusal(codec.BAD_CHECKSUM)
         if n == 1 else _ok(f, r, 0), 'success', 2),
    Case('not synchronised, then answered', lambda f, r, n: _refusal(codec.NOT_SYNCHRONISED)
         if n == 1 else _ok(f, r, 0), 'success', 2),
    Case('too long', lambda f, r, n: _refusal(0x20), 'refused', 1),
    Case('executed, never answered', lambda f, r, n: Answer([], True), 'timeout', 1),
    Case('lost on the way', lambda f, r, n: Answer(), 'timeout', 1),
    Case('answered late', lambda f, r, n: _ok(f, r, MOTION_TIMEOUT + _LATE), 'timeout', 1),
    Case('answer damaged', lambda f, r, n: _damaged(f, r), 'timeout', 1),
    Case('answered twice at once', lambda f, r, n: _ok(f, r, 0, 0), 'success', 1),
    Case('answered twice, 5 ms apart', lambda f, r, n: _ok(f, r, 0, 0.005), 'success', 1),
    Case('answered twice, 40 ms apart', lambda f, r, n: _ok(f, r, 0, 0.04), 'success', 1))


class Calls:
    """Calls with numbers of their own, and the rows of what they were told."""

    def __init__(self, field: Field) -> None:
        row = field.row
        self.field = field
        self.success = row('bus', 'told success: executed exactly once')
        self.refused = row('bus', 'told refused or not sent: not executed')
        self.timeout = row('bus', 'told timeout: executed once or not at all')
        self.again = row('bus', 'nothing that moves is sent again unless the board did nothing')
        self.as_was = row('bus', 'what a caller is told is what the board answered')
        self.in_time = row('bus', 'a call always answers: its timeout + 0.8 s, 0.2 s for ROS')
        self.others = row('bus', 'no late or doubled reply answers another request')
        self._number = 0

    def arguments(self, service: str) -> Tuple[Tuple, Key]:
        """Of the next call, and the (CMD2, DATE) by which the board knows it."""
        self._number = n = self._number + 1
        if service == 'bus/request':
            data = struct.pack('<I', n)
            return (codec.FUNCTION, MEMORY, data), (MEMORY, data)
        pair = n % 2, n // 2 % 256
        cmd2 = {'lift': codec.LIFT, 'gimbal': codec.GIMBAL, 'press': PRESS}[service]
        return pair, (cmd2, bytes(pair))

    def make(self, service: str, what: str, wanted: str, limit: float = MOTION_TIMEOUT) -> Key:
        """One call, which has to be told what is `wanted`; its key."""
        given, key = self.arguments(service)
        self.judge(key, self.field.robot.call(service, *given), f'{service} {what}', wanted, limit)
        return key

    def begin(self) -> Tuple[Key, 'Future[Told]']:
        """A call of the lift, which is executed and never answered."""
        given, key = self.arguments('lift')
        self.field.bus.rule = lambda request: Answer([], True)
        asked = self.field.robot.calling('lift', *given)
        self.timeout.wait(lambda: self.field.bus.executed[key], 'the call arrives')
        return key, asked

    def judge(self, key: Key, told: Told, what: str, wanted: str, limit: float) -> None:
        """Hold one answer against the board."""
        executed = self.field.bus.executed[key]
        said = f'{what}: told {told.status} "{told.message[:90]}", executed {executed} times'
        self.in_time.at_most(told.seconds, limit + WAIT + _SLACK, 's', what)
        how = 'success' if told.success else {
            TIMEOUT: 'timeout', NOT_SENT: 'not sent'}.get(told.status, 'refused')
        self.as_was.check(how == wanted, f'{said}, was {wanted}')
        if told.success:
            self.success.check(executed == 1, said)
            self.others.check(key[0] != MEMORY or told.data == key[1],
                              f'{what}: answered with the data of another')
        elif how == 'timeout':
            self.timeout.check(executed <= 1, said)
        else:
            self.refused.check(executed == 0, said)

    def received(self, key: Key, times: int, what: str, connection: int = 0) -> None:
        """The board has received this request so often, since that connection."""
        seen = sum(request.key == key and request.connection >= connection
                   for request in self.field.bus.requests)
        self.again.check(seen == times, f'{what}: received {seen} times, should be {times}')


def answers(field: Field) -> None:
    """Every service, whatever the board makes of the request; and behind each such call one that
    the board refuses, which an answer of before must not make a success."""
    calls = Calls(field)
    for service in ('lift', 'gimbal', 'bus/request', 'press'):
        for case in CASES:
            field.calm()
            given, key = calls.arguments(service)

            def rule(request: Request) -> Answer:
                if request.key != key:
                    return _refusal(codec.FAILED, codec.ERROR)
                times = [one.key for one in field.bus.requests].count(key)
                return case.rule(field, request, times)

            field.bus.rule = rule
            told = field.robot.call(service, *given)
            # The next call comes at once: what is late or doubled is still under way.
            behind = field.robot.call('probe')
            what = f'{service} {case.name}'
            calls.judge(key, told, what, case.told, MOTION_TIMEOUT)
            calls.received(key, case.received, what)
            calls.others.check(not behind.success,
                               f'{what}: a call behind it, which was refused, was told as done')


def fences(field: Field) -> None:
    """A fence before every request: an ECHO with a fresh nonce, answered, in front of each."""
    row = field.row('bus', 'before every call stands a fence: an ECHO with a fresh nonce')
    calls = Calls(field)
    nonces: List[bytes] = []
    for index in range(12):
        field.calm()
        key = calls.make('lift' if index % 2 else 'bus/request', 'alone', 'success')
        requests = list(field.bus.requests)
        at = [request.key for request in requests].index(key)
        before = requests[at - 1] if at else None
        row.check(before and before.cmd1 == codec.ECHO and before.data not in nonces,
                  f'call {index}: before it came {before}')
        nonces += [before.data] if before else []


def queue(field: Field) -> None:
    """Eight callers at once, and a board that takes its time: one request is outstanding, ever."""
    row = field.row('bus', 'one request is outstanding, ever')
    calls = Calls(field)
    field.calm()
    busy = [0.0]

    def rule(request: Request) -> Answer:
        row.check(request.t >= busy[-1], f'{request} came before the reply to another')
        busy.append(request.t + 0.03)
        return _ok(field, request, 0.03)

    field.bus.rule = rule
    made = [calls.arguments('bus/request') for _ in range(8)]
    asked = [field.robot.calling('bus/request', *given) for given, _key in made]
    for (_given, key), future in zip(made, asked):
        calls.judge(key, future.result(PATIENCE), 'one of eight at once', 'success', REPLY_TIMEOUT)


def stopped_caller(field: Field) -> None:
    """SIGSTOP of a caller while the board works for it: others are served, and then it is told."""
    served = field.row('bus', 'a caller that is stopped holds up nobody, and is told the truth')
    calls = Calls(field)
    child = field.user('caller', 'stopped_caller')
    for index in range(3):
        field.calm()
        pair, key = calls.arguments('lift')
        field.bus.rule = lambda request: _ok(field, request, 0.05)
        child.order(f'{pair[0]} {pair[1]}')
        served.wait(lambda: field.bus.executed[key], 'the call arrives')
        child.hold()
        for _ in range(3):
            calls.make('bus/request', 'of another caller', 'success')
        child.send(signal.SIGCONT)
        served.wait(lambda: child.tail().count('told True') > index, 'it is told')
        served.check(field.bus.executed[key] == 1, f'executed {field.bus.executed[key]} times')
    field.end(child)


def unplugged_while_asked(field: Field) -> None:
    """The port goes before the reply comes; and calls while it is gone."""
    calls, back = Calls(field), field.row(*BACK)
    first = field.row('bus', 'after a reconnect SYNC, until the board answers, and nothing else')
    for index in range(3):
        field.calm()
        asked, future = calls.begin()
        field.bus_line.unplug()
        calls.judge(asked, future.result(PATIENCE), 'unplugged while asked', 'timeout',
                    MOTION_TIMEOUT)
        absent = calls.make('lift', 'while unplugged', 'not sent', WAIT)
        connection, field.bus.rule = field.bus.connection, None
        began, count = time.monotonic(), len(field.bus.requests)
        field.bus_line.plug(another_name=bool(index % 2))
        field.wait(lambda: len(field.bus.requests) > count, 'the port is opened again')
        opened = field.bus.requests[count]
        back.at_most(opened.t - began, RETURN, 's', 'bus')
        first.check(opened.cmd1 == codec.SYNC, f'the first request was {opened}')
        calls.make('lift', 'after a reconnect', 'success')
        for key in (asked, absent):
            calls.received(key, 0, 'a request of before the reconnect', connection)


def stopped_bridge(field: Field) -> None:
    """SIGSTOP of the bridge while it waits for a reply, which comes meanwhile: it is old."""
    calls = Calls(field)
    for _ in range(2):
        field.calm()
        key, asked = calls.begin()
        with field.held():
            field.bus_line.write(reply(codec.OK))
            field.let_pass(1.0)
        field.bus.rule = None
        calls.judge(key, asked.result(PATIENCE), 'the bridge was stopped meanwhile', 'timeout',
                    MOTION_TIMEOUT + 1.0)
        calls.received(calls.make('lift', 'behind a stop', 'success'), 1, 'behind a stop')


def polls(field: Field) -> None:
    """Two polled functions of one length and the air, every reply twice: none gets another's."""
    row = field.row('bus', 'every polled value is one that the board gave for that function')
    for delay in (0.0, 0.005, 0.04):
        field.robot.forget()
        field.bus.rule = lambda request: _ok(field, request, 0, delay)
        for topic in ('~depth', '~height', '~environment'):
            row.wait(lambda: len(field.robot.got[topic]) >= 5, f'{topic} is polled')
    field.bus.rule = None
    for topic in ('~depth', '~height', '~environment'):
        given = {one.key: one.wall for one in field.bus.sent if one.topic == topic}
        for one in list(field.robot.got[topic]):
            row.check(one.key in given, f'{topic}: {one.key}, which the board never gave for it')
            if one.key in given:
                field.judge_stamp(given[one.key], one, topic)


SCENARIOS = answers, fences, queue, stopped_caller, unplugged_while_asked, stopped_bridge
