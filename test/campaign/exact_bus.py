"""The bus, exactly: compares what each call returned with what the board did.

Each call has a unique number, so it is compared with exactly one request. One call is made at a
time, and the line is quiet before it, unless the scenario says otherwise.
"""
import signal
import struct
import time
from concurrent.futures import Future
from typing import Callable, List, NamedTuple, Tuple

import by_definition as codec
from .boards import MEMORY, PRESS, Reaction, Request, reply_frame
from .requirements import MAX_WAIT
from .rig import (MOTION_TIMEOUT, PORT_RETURN, PORT_RETURNS, REPLY_TIMEOUT, MachineTooBusy,
                  Rig)
from .robot import NOT_SENT, TIMEOUT, Outcome

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


def _ok(rig: Rig, request: Request, *delays: float) -> Reaction:
    return Reaction([(delay, rig.bus.ok_reply(request)) for delay in delays], True)


def _refusal(code: int, kind: int = codec.INVALID) -> Reaction:
    return Reaction([(0, reply_frame(kind, struct.pack('<H' if code > 255 else '<B', code)))])


def _damaged(rig: Rig, request: Request) -> Reaction:
    frame = bytearray(rig.bus.ok_reply(request))
    frame[2] ^= 0x10
    return Reaction([(0, bytes(frame))], True)


CASES = (
    Case('with a reply', lambda rig, r, n: _ok(rig, r, 0), 'done', 1),
    Case('with a reply after noise', lambda rig, r, n: Reaction(
        [(0, b'\x00\x13' + rig.bus.ok_reply(r))], True), 'done', 1),
    Case('failed', lambda rig, r, n: _refusal(codec.FAILED, codec.ERROR), 'refused', 1),
    Case('bad checksum, then a reply', lambda rig, r, n: _refusal(codec.BAD_CHECKSUM)
         if n == 1 else _ok(rig, r, 0), 'done', 2),
    Case('not synchronised, then a reply', lambda rig, r, n: _refusal(codec.NOT_SYNCHRONISED)
         if n == 1 else _ok(rig, r, 0), 'done', 2),
    Case('too long', lambda rig, r, n: _refusal(0x20), 'refused', 1),
    Case('executed without a reply', lambda rig, r, n: Reaction([], True), 'not known', 1),
    Case('lost request', lambda rig, r, n: Reaction(), 'not known', 1),
    Case('late reply', lambda rig, r, n: _ok(rig, r, MOTION_TIMEOUT + _LATE), 'not known', 1),
    Case('damaged reply', lambda rig, r, n: _damaged(rig, r), 'not known', 1),
    Case('two replies at once', lambda rig, r, n: _ok(rig, r, 0, 0), 'done', 1),
    Case('two replies, 5 ms apart', lambda rig, r, n: _ok(rig, r, 0, 0.005), 'done', 1),
    Case('two replies, 40 ms apart', lambda rig, r, n: _ok(rig, r, 0, 0.04), 'done', 1))


class Calls:
    """Makes calls with unique numbers, and checks their outcomes."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.done = rig.require('bus', 'outcome done: executed exactly once')
        self.refused = rig.require('bus', 'outcome refused or not sent: not executed')
        self.not_known = rig.require('bus', 'outcome not known: executed at most once')
        self.sent_again = rig.require('bus', 'a motion is sent again only if it was not executed')
        self.matches = rig.require('bus', 'the outcome of a call matches what the board replied')
        self.in_time = rig.require('bus', 'a call returns within timeout + 0.8 s + 0.2 s for ROS')
        self.own_reply = rig.require('bus', 'no late or doubled reply is used for another request')
        self._number = 0

    def next_arguments(self, service: str) -> Tuple[Tuple, Key]:
        """The arguments of the next call, and the key of its request."""
        self._number = n = self._number + 1
        if service == 'bus/request':
            data = struct.pack('<I', n)
            return (codec.FUNCTION, MEMORY, data), (MEMORY, data)
        pair = n % 2, n // 2 % 256
        cmd2 = {'lift': codec.LIFT, 'gimbal': codec.GIMBAL, 'press': PRESS}[service]
        return pair, (cmd2, bytes(pair))

    def call(self, service: str, what: str, wanted: str, limit: float = MOTION_TIMEOUT) -> Key:
        """Make one call and check its outcome; return the key of its request."""
        arguments, key = self.next_arguments(service)
        outcome = self.rig.robot.call(service, *arguments)
        self.check(key, outcome, f'{service} {what}', wanted, limit)
        return key

    def start_unanswered(self) -> Tuple[Key, 'Future[Outcome]']:
        """Start a call of the lift, which is executed without a reply."""
        arguments, key = self.next_arguments('lift')
        self.rig.bus.react = lambda request: Reaction([], True)
        call = self.rig.robot.start_call('lift', *arguments)
        self.not_known.wait(lambda: self.rig.bus.executed[key], 'the request arrives')
        return key, call

    def check(self, key: Key, outcome: Outcome, what: str, wanted: str, limit: float) -> None:
        """Compare one outcome with what the board did."""
        executed = self.rig.bus.executed[key]
        text = f'{what}: {outcome.status} "{outcome.message[:90]}", executed {executed} times'
        self.in_time.at_most(outcome.seconds, limit + QUEUE_TIME + _ROS_TIME, 's', what)
        name = 'done' if outcome.success else {
            TIMEOUT: 'not known', NOT_SENT: 'not sent'}.get(outcome.status, 'refused')
        if name == 'not sent' != wanted and 'while the bridge stalled' in outcome.message:
            raise MachineTooBusy
        self.matches.check(name == wanted, f'{text}, expected "{wanted}"')
        if outcome.success:
            self.done.check(executed == 1, text)
            self.own_reply.check(key[0] != MEMORY or outcome.data == key[1], f'{what}: other data')
        elif name == 'not known':
            self.not_known.check(executed <= 1, text)
        else:
            self.refused.check(executed == 0, text)

    def check_received(self, key: Key, times: int, what: str, connection: int = 0) -> None:
        """Check how often the board has received this request since that connection."""
        received = sum(request.key == key and request.connection >= connection
                       for request in self.rig.bus.requests)
        self.sent_again.check(received == times, f'{what}: received {received} times, not {times}')


def outcomes(rig: Rig) -> None:
    """Every service in every case; after each call one that the board refuses, which must fail."""
    calls = Calls(rig)
    for service in ('lift', 'gimbal', 'bus/request', 'press'):
        for case in CASES:
            rig.settle()
            arguments, key = calls.next_arguments(service)

            def react(request: Request) -> Reaction:
                if request.key != key:
                    return _refusal(codec.FAILED, codec.ERROR)
                times = [each.key for each in rig.bus.requests].count(key)
                return case.react(rig, request, times)

            rig.bus.react = react
            outcome = rig.robot.call(service, *arguments)
            # Without a pause: late or doubled replies may still arrive.
            second = rig.robot.call('probe')
            what = f'{service} {case.name}'
            calls.check(key, outcome, what, case.outcome, MOTION_TIMEOUT)
            calls.check_received(key, case.received, what)
            calls.own_reply.check(not second.success, f'{what}: a refused call returned success')


def fences(rig: Rig) -> None:
    required = rig.require('bus', 'a fence, an ECHO with a fresh nonce, precedes every call')
    calls = Calls(rig)
    nonces: List[bytes] = []
    for index in range(12):
        rig.settle()
        key = calls.call('lift' if index % 2 else 'bus/request', 'alone', 'done')
        requests = list(rig.bus.requests)
        at = [request.key for request in requests].index(key)
        before = requests[at - 1] if at else None
        required.check(before and before.cmd1 == codec.ECHO and before.data not in nonces,
                       f'call {index}: the request before it was {before}')
        nonces += [before.data] if before else []


def queue(rig: Rig) -> None:
    """Eight callers at once, and a board that replies after 30 ms."""
    required = rig.require('bus', 'at most one request is outstanding')
    calls = Calls(rig)
    rig.settle()
    replied_at = [0.0]

    def react(request: Request) -> Reaction:
        required.check(request.t >= replied_at[-1], f'{request} arrived before the last reply')
        replied_at.append(request.t + 0.03)
        return _ok(rig, request, 0.03)

    rig.bus.react = react
    made = [calls.next_arguments('bus/request') for _ in range(8)]
    futures = [rig.robot.start_call('bus/request', *arguments) for arguments, _key in made]
    for (_arguments, key), future in zip(made, futures):
        calls.check(key, future.result(MAX_WAIT), 'one of eight at once', 'done', REPLY_TIMEOUT)


def suspended_caller(rig: Rig) -> None:
    """SIGSTOP of a caller while the board executes its request; other callers are served."""
    required = rig.require('bus', 'a suspended caller delays no other call; its outcome is true')
    calls = Calls(rig)
    child = rig.user('caller', 'suspended_caller')
    for index in range(3):
        rig.settle()
        pair, key = calls.next_arguments('lift')
        rig.bus.react = lambda request: _ok(rig, request, 0.05)
        child.order(f'{pair[0]} {pair[1]}')
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
    calls, returns = Calls(rig), rig.require(*PORT_RETURNS)
    sync = rig.require('bus', 'after a reconnect the first request is SYNC')
    for index in range(3):
        rig.settle()
        outstanding, future = calls.start_unanswered()
        rig.bus_line.unplug()
        calls.check(outstanding, future.result(MAX_WAIT), 'unplugged', 'not known', MOTION_TIMEOUT)
        absent = calls.call('lift', 'while unplugged', 'not sent', QUEUE_TIME)
        connection, rig.bus.react = rig.bus.connection, None
        began, count = time.monotonic(), len(rig.bus.requests)
        rig.bus_line.plug(another_name=bool(index % 2))
        rig.wait(lambda: len(rig.bus.requests) > count, 'the port is opened again')
        first = rig.bus.requests[count]
        returns.at_most(first.t - began, PORT_RETURN, 's', 'bus')
        sync.check(first.cmd1 == codec.SYNC, f'the first request was {first}')
        calls.call('lift', 'after a reconnect', 'done')
        for key in (outstanding, absent):
            calls.check_received(key, 0, 'a request from before the reconnect', connection)


def suspended_bridge(rig: Rig) -> None:
    """SIGSTOP of the bridge while it waits for a reply, which arrives meanwhile, so it is stale.

    A call that is made meanwhile is not sent.
    """
    calls = Calls(rig)
    late = rig.require('bus', 'what moves is not sent if it was called during a stall')
    for _ in range(2):
        rig.settle()
        key, future = calls.start_unanswered()
        with rig.suspended():
            rig.bus_line.write(reply_frame(codec.OK))
            arguments, old_key = calls.next_arguments('lift')
            old = rig.robot.start_call('lift', *arguments)
            rig.sleep(1.0)
        rig.bus.react = None
        calls.check(key, future.result(MAX_WAIT), 'stall', 'not known', MOTION_TIMEOUT + 1.0)
        calls.check(old_key, old.result(MAX_WAIT), 'called during a stall', 'not sent',
                    MOTION_TIMEOUT + 1.0)
        rig.wait_heartbeats(70)     # moves are refused until 0.5 s after a stall
        late.check(rig.bus.executed[old_key] == 0, 'it was executed')
        calls.check_received(calls.call('lift', 'after a stall', 'done'), 1, 'after a stall')


def polls(rig: Rig) -> None:
    """Two polled functions with equally long replies, and the environment; all replies doubled."""
    required = rig.require('bus', 'every polled value is from a reply to that function')
    for delay in (0.0, 0.005, 0.04):
        rig.robot.clear_records()
        rig.bus.react = lambda request: _ok(rig, request, 0, delay)
        for topic in ('~depth', '~height', '~environment'):
            required.wait(lambda: len(rig.robot.published[topic]) >= 5, f'{topic} is polled')
    rig.bus.react = None
    for topic in ('~depth', '~height', '~environment'):
        sent = {each.key: each.wall for each in rig.bus.sent if each.topic == topic}
        for message in list(rig.robot.published[topic]):
            required.check(message.key in sent, f'{topic}: {message.key}, which was not sent')
            if message.key in sent:
                rig.check_stamp(sent[message.key], message, topic)


SCENARIOS = outcomes, fences, queue, suspended_caller, unplugged_during_call, suspended_bridge
