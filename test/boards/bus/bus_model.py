"""A model of a board on a robot-ctrl-bus, its line and its callers, with a simulated clock.

The line loses, delays, doubles and damages replies as a list of faults says. The tested Master is
called as `BusLink` calls it, with a real decoder in between. The line keeps the order: a late or
doubled reply arrives before anything that the board sends afterwards.

A fault is a name of `FAULTS`, ('late', s) for a reply that is s seconds late, or ('double', s) for
one that arrives again s seconds later.
"""
import heapq
import itertools
import logging
from typing import List, NamedTuple, Optional

from serial_communication.boards.bus.call import NOT_SENT, TIMEOUT, Call
from serial_communication.boards.bus.master import Master
from serial_communication.framing.rows import BOARD, FILE
from serial_communication.link.sparing_log import SparingLog
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.layout import Layout

REPLY_TIMEOUT, MOTION_TIMEOUT = 0.5, 2.0
_FRAME_TIMEOUT = 0.05

FAULTS = ('none', 'lose request', 'lose reply', ('late', REPLY_TIMEOUT + 0.2),
          ('late', MOTION_TIMEOUT + 0.9), ('double', 0.0), ('double', 0.005), ('double', 0.1),
          ('double', MOTION_TIMEOUT), 'damage reply', 'damage request', 'damage request, silent',
          'noise', 'noise before', 'cut', 'error', 'too long', 'reset',
          'invalid for noise', 'unsynchronised for noise', 'invalid for noise, damage reply',
          'damage flag, invalid behind')
UNREPEATABLE = ('lift', 'gimbal', 'raw', 'act', 'own')  # never sent again after a timeout
REPEATABLE = ('read', 'test', 'stop')                 # functions that may be sent again
REQUESTS = UNREPEATABLE + REPEATABLE + ('air', 'echo', 'sync')
POLLS = ('poll air', 'poll one', 'poll two')
RAW, ACT, READ, TEST, STOP, ONE, TWO = 0x30, 0x31, 0x32, 0x33, 0x2F, 0x40, 0x41    # CMD2
OWN = 0x42      # an announced function
_READ = Layout('<4x', ())      # 'read' returns its request's data reversed
_VALUE = Layout('<6x', ())     # of both polled functions, and as long as an environment's


class ModelCall(NamedTuple):
    """One call and what the model needs to check its outcome."""

    call: Call
    kind: str
    at: float
    executed_before: int      # what the board had executed before the call


class Board:
    """Executes requests and answers them on a line with faults."""

    def __init__(self, faults, echoes: bool, ok_data: bytes) -> None:
        self.executed: List[bus.Request] = []
        self.latest = {}               # request -> whether it was executed the last time
        self.readings = 0
        self._faults = iter(faults)
        self._echoes = echoes
        self.ok_data = ok_data
        self.restarts = 0              # after each, its functions may be others
        self.asked_at: Optional[int] = None    # the restart after which its announcement was read
        self._synchronised = False
        self._line_free = 0.0

    def heal(self) -> None:
        """No more faults."""
        self._faults = iter(())

    def take(self, request: bus.Request, now: float) -> List[tuple]:
        """Receive a request; return the replies as (time, bytes) at the Master's end."""
        fault, seconds = next(self._faults, 'none'), 0.0
        if isinstance(fault, tuple):
            fault, seconds = fault
        if fault in ('lose request', 'damage request, silent'):
            return []
        self.latest[request] = False
        if fault == 'reset':
            self._synchronised = False
            self.restarts += 1
            return self._at(now, b'boot\xa5')
        if fault == 'damage request':
            return self._at(now, bus.encode_reply(bus.Reply(bus.INVALID, b'\x40')))
        if fault == 'too long':
            return self._at(now, bus.encode_reply(bus.Reply(bus.INVALID, b'\x20')))
        before = b''
        if 'for noise' in fault:
            code = b'\x10' if fault == 'unsynchronised for noise' else b'\x40'
            before = bus.encode_reply(bus.Reply(bus.INVALID, code))
        reply = self._execute(request, fault == 'error')
        if reply is None or fault == 'lose reply':
            return self._at(now, before) if before else []
        wire = bus.encode_reply(reply)
        if 'damage reply' in fault:
            wire = wire[:-1] + bytes((wire[-1] ^ 4,))
        elif fault == 'damage flag, invalid behind':
            wire = bytes((wire[0] ^ 1,)) + wire[1:] \
                + bus.encode_reply(bus.Reply(bus.INVALID, b'\x40'))
        elif fault == 'noise':
            wire = b'\x11\x22' + wire
        elif fault == 'noise before':
            return self._at(now, b'\xa5\x03') + self._at(now + 0.2, wire)
        elif fault == 'cut':
            wire = wire[:-1]
        came = self._at(now, before) if before else []
        if fault == 'late':
            return came + self._at(now + seconds, wire)
        came += self._at(now + 0.01, wire)
        if fault == 'double':
            came += self._at(now + 0.01 + seconds, wire)
        return came

    def _at(self, when: float, wire: bytes) -> List[tuple]:
        """The line keeps the order."""
        self._line_free = max(self._line_free, when)
        return [(self._line_free, wire)]

    def _execute(self, request: bus.Request, failing: bool) -> Optional[bus.Reply]:
        if request.cmd1 == bus.SYNC:
            self._synchronised = True
            return bus.Reply(bus.SYNC)
        if not self._synchronised:
            return bus.Reply(bus.INVALID, b'\x10')
        if request.cmd1 == bus.ECHO:
            return bus.Reply(bus.ECHO, request.data) if self._echoes else None
        if failing:
            return bus.Reply(bus.ERROR, b'\2\x80')
        assert request.cmd2 != OWN or self.asked_at == self.restarts, 'sent to another board'
        self.executed.append(request)
        self.latest[request] = True
        if request == bus.ENVIRONMENT_REQUEST:
            self.readings += 1
            return bus.Reply(bus.OK, bus.Environment(self.readings, 20.0, 50.0).pack())
        if request.cmd2 in (ONE, TWO):
            return bus.Reply(bus.OK, bytes((request.cmd2,)) * 6)
        return bus.Reply(bus.OK, request.data[::-1] if request.cmd2 in (RAW, READ)
                         else self.ok_data)


class Model:
    """Callers, Master, line and board together."""

    def __init__(self, faults=(), echoes: bool = True, ok_data: bytes = b'') -> None:
        self.now = 10.0
        self.board = Board(faults, echoes, ok_data)
        self.asked: List[ModelCall] = []
        self.sent: List[bus.Request] = []       # by the Master
        logger = logging.getLogger('bus model')
        logger.propagate = False
        nonces = itertools.count()
        self.master = Master(REPLY_TIMEOUT, MOTION_TIMEOUT, SparingLog('bus', logger),
                             lambda: b'N%03d' % next(nonces), begun_anew=self._begun_anew,
                             still_announces=lambda: self.board.asked_at is not None,
                             echoes=echoes)
        self._decoder = bus.ReplyDecoder()
        self._line: List[tuple] = []        # (time, number, bytes) on their way to the Master
        self._number = itertools.count()
        self._last_byte = 0.0
        self._wake_at = None        # when the Master has to be called again
        self._connected = False
        self.connect()

    def connect(self) -> None:
        """The port opens, without earlier bytes."""
        if not self._connected:
            self._connected = True
            self._decoder.reset()
            self._line.clear()
            self.board.asked_at = None
            self.master.connected(self.now)

    def _begun_anew(self, _now: float) -> None:
        self.board.asked_at = None

    def disconnect(self) -> None:
        """The port closes."""
        if self._connected:
            self._connected = False
            self.master.disconnected(self.now, 'unplugged')

    def submit(self, kind: str) -> None:
        """A caller submits a request; all requests differ from each other."""
        number = len(self.asked)
        tag = number.to_bytes(3, 'little')
        request = {
            'lift': bus.lift(number % 2, number // 2 % 256),
            'gimbal': bus.gimbal(number % 4, number // 4 % 256),
            'raw': bus.Request(bus.FUNCTION, RAW, b'r' + tag),
            'act': bus.Request(bus.FUNCTION, ACT, b'a' + tag),
            'own': bus.Request(bus.FUNCTION, OWN, b'o' + tag),
            'read': bus.Request(bus.FUNCTION, READ, b'f' + tag),
            'test': bus.Request(bus.FUNCTION, TEST, b't' + tag),
            'stop': bus.Request(bus.FUNCTION, STOP, b's' + tag),
            'air': bus.ENVIRONMENT_REQUEST,
            'echo': bus.echo(b'e' + tag),
            'sync': bus.SYNC_REQUEST,
            'poll air': bus.ENVIRONMENT_REQUEST,
            'poll one': bus.Request(bus.FUNCTION, ONE),
            'poll two': bus.Request(bus.FUNCTION, TWO)}[kind]
        layout = {'raw': bus.ANY_DATA, 'echo': bus.ANY_DATA, 'sync': bus.ANY_DATA, 'read': _READ,
                  'air': bus.Environment.LAYOUT, 'poll air': bus.Environment.LAYOUT,
                  'poll one': _VALUE, 'poll two': _VALUE}.get(kind, bus.NO_DATA)
        slow = kind in ('lift', 'gimbal')
        function = bus.Function(kind, request.cmd2, cmd1=request.cmd1, reply=layout,
                                repeatable=kind not in UNREPEATABLE, interrupts=kind == 'stop',
                                origin=BOARD if kind == 'own' else FILE)
        call = Call(request, function, MOTION_TIMEOUT if slow else REPLY_TIMEOUT, 3 - number % 3,
                    self.now, kind in POLLS)
        self.asked.append(ModelCall(call, kind, self.now, self.board.readings))
        self.master.submit(call)
        if kind == 'stop' and self._connected:
            before = len(self.sent)
            self._step()
            assert request in self.sent[before:], 'the stop was not sent at once'

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while True:
            self._step()
            due = [end]
            if self._line:
                due.append(self._line[0][0])
            if self._decoder.pending:
                due.append(self._last_byte + _FRAME_TIMEOUT)
            if self._wake_at is not None:
                due.append(self._wake_at)
            following = min(due)
            if following >= end:
                self.now = end
                return
            self.now = max(following, self.now + 1e-4)

    def _step(self) -> None:
        """As in `BusLink.tick`: everything received is decoded before anything is sent."""
        while True:
            while self._line and self._line[0][0] <= self.now:
                _, _, wire = heapq.heappop(self._line)
                self._last_byte = self.now
                self._deliver(self._decoder.feed(wire))
            while self._decoder.pending and self.now >= self._last_byte + _FRAME_TIMEOUT:
                self._deliver(self._decoder.give_up())
            if self.board.asked_at is None and self.master.in_step:
                self.board.asked_at = self.board.restarts
            request, self._wake_at = self.master.step(
                self.now, 'the rest' if self._decoder.begun else '')
            if request is None:
                return
            self.sent.append(request)
            for when, wire in self.board.take(request, self.now):
                heapq.heappush(self._line, (when, next(self._number), wire))

    def _deliver(self, frames) -> None:
        if not self._connected:
            return
        for frame in frames:
            if frame.cause:
                self.master.damaged(frame, self.now)
            else:
                self.master.received(frame, self.now)

    # -- the invariants ---------------------------------------------------------------------

    def check(self) -> None:
        """Every outcome is true."""
        for asked in self.asked:
            outcome = asked.call.outcome
            if outcome is None:
                continue
            request = asked.call.request
            times = self.board.executed.count(request)
            text = '%s was reported as %r and executed %d times' % (request, outcome, times)
            refused = not outcome.success and outcome.status != TIMEOUT
            assert not refused or outcome.status in (NOT_SENT, bus.ERROR, bus.INVALID), text
            if asked.kind in UNREPEATABLE:
                if outcome.success:
                    assert times == 1, text
                    assert asked.kind == 'raw' or outcome.data == self.board.ok_data, text
                elif refused:
                    assert times == 0, text
                else:
                    assert times <= 1, text
            if asked.kind in REPEATABLE:
                # It may be sent again; the outcome is that of the last try.
                if outcome.success:
                    assert times >= 1 and self.board.latest[request], text
                elif refused:
                    assert not self.board.latest.get(request), text
            if outcome.success:
                self._check_data(asked, request, outcome.data, text)
        once = [request for request in self.board.executed
                if request.cmd2 not in (READ, TEST, STOP, ONE, TWO, bus.ENVIRONMENT)]
        assert len(set(once)) == len(once), 'executed twice'

    @staticmethod
    def _check_data(asked: ModelCall, request: bus.Request, data: bytes, text: str) -> None:
        """The data belongs to this function."""
        if asked.kind in ('raw', 'read'):
            assert data == request.data[::-1], text
        elif asked.kind == 'echo':
            assert data == request.data, text
        elif asked.kind in ('poll one', 'poll two'):
            assert data == bytes((request.cmd2,)) * 6, text
        elif asked.kind in ('air', 'poll air'):
            reading = bus.Environment.unpack(data)
            assert (reading.temperature, reading.humidity) == (20.0, 50.0), text
            # A poll after the same poll has no fence, so a doubled reply to the first one may be
            # taken for the reply to the second one.
            assert asked.kind == 'poll air' or reading.smoke > asked.executed_before, \
                'a reading from before the call'

    def check_all_answered(self) -> None:
        """Every call has an outcome."""
        assert all(asked.call.outcome is not None for asked in self.asked)
