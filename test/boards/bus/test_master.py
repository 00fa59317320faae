"""The Master's session as a state machine: every rule; the tests set the time."""
import logging

import pytest

from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.call import Call
from serial_communication.boards.bus.master import Master
from serial_communication.boards.bus.session import (ECHO_TRIES, TRANSITIONS, Event, Kind,
                                                     SessionState)
from serial_communication.framing.layout import Layout, Value
from serial_communication.framing.stream import CHECKSUM, FRAMING, Frame, invalid_frame
from serial_communication.link.outcome import NOT_SENT, TIMEOUT
from serial_communication.link.sparing_log import SparingLog

REPLY_TIMEOUT, MOTION_TIMEOUT = 0.5, 5.0
AIR_REPLY = bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack())
TWO_BYTES = Layout('<H', [Value('number')])
REQUESTS = {
    'lift': bus.lift(0, 100), 'gimbal': bus.gimbal(1, 30), 'air': bus.ENVIRONMENT_REQUEST,
    'raw': bus.Request(bus.FUNCTION, 0x30, b'raw'), 'echo': bus.echo(b'mine'),
    'sync': bus.SYNC_REQUEST, 'stop': bus.Request(bus.FUNCTION, 0x2F),
    'custom': bus.Request(bus.FUNCTION, 0x40), 'twice': bus.Request(bus.FUNCTION, 0x43),
    'read': bus.Request(bus.FUNCTION, 0x41), 'other': bus.Request(bus.FUNCTION, 0x42),
    'own': bus.Request(bus.FUNCTION, 0x44), 'ownstop': bus.Request(bus.FUNCTION, 0x45),
    'two': bus.Request(bus.FUNCTION, 0x46)}
FUNCTIONS = {name: bus.built_in(request, bus.Function(name, request.cmd2))
             for name, request in REQUESTS.items()}
FUNCTIONS.update(
    raw=bus.RAW,
    stop=FUNCTIONS['stop']._replace(repeatable=True, interrupts=True),
    read=FUNCTIONS['read']._replace(repeatable=True, reply=TWO_BYTES),
    other=FUNCTIONS['other']._replace(repeatable=True, reply=TWO_BYTES),
    twice=FUNCTIONS['twice']._replace(repeatable=True),
    two=FUNCTIONS['two']._replace(reply=Layout('<2x', ())),
    own=FUNCTIONS['own']._replace(announced=True),
    ownstop=FUNCTIONS['ownstop']._replace(repeatable=True, interrupts=True, announced=True))
STATES = {'not known': TIMEOUT, 'not sent': NOT_SENT, 'refused': bus.ERROR, 'invalid': bus.INVALID}


class Session:
    """A Master with its clock and its log, which plays scripts.

    The steps of a script, with `;` between them, are:

        call NAME [TRIES], poll NAME   a caller submits that request
        > NAME, > SYNC, > ECHO, > -    this is sent now: SYNC and ECHO by the Master itself
        send NAME                      the same; a fence before it, if any, returns first
        fence                          an ECHO is sent and returns
        < REPLY …                      these replies are received, in one read. ECHO returns the
                                       latest one, -ECHO the one before; REPLY:DATA has other data
        damaged, noise, missed         a frame with a wrong checksum, other bytes, a stall
        +S                             S seconds pass; T stands for the reply timeout, M for that
                                       of motions
        connected, disconnected        the port opens, and the board answers; it closes
        refused                        the port does not take the request
        given up NAME                  the caller gives up
        NAME is OUTCOME                the latest call of that name has it; waiting: it has none
        in step, out of step           calls can be sent, or not; lost: the board needs a SYNC
    """

    def __init__(self, caplog, motion_timeout=MOTION_TIMEOUT, echoes=True):
        caplog.set_level(logging.INFO)
        self._caplog = caplog
        self.now = 100.0
        self.nonces = [b'none']
        self.calls = {}         # the latest by name
        self.dropped = []       # when each request was sent for which output was dropped
        self.begun_anew = []    # when the board may have, since the test began
        self.announces = False
        self._motion_timeout = motion_timeout
        self.master = Master(REPLY_TIMEOUT, motion_timeout, SparingLog(
            'bus', logging.getLogger('session'), clock=lambda: self.now), self._nonce,
            drop_output=self.dropped.append, begun_anew=self._begin_anew,
            still_announces=lambda: self.announces, echoes=echoes)
        self._echoes = echoes

    def _begin_anew(self, now):
        self.begun_anew.append(now)
        self.announces = False

    def _nonce(self):
        self.nonces.append(b'n%03d' % len(self.nonces))
        return self.nonces[-1]

    def call(self, name, tries=3, poll=False, on_success=None, **changes):
        """Submit a call as `BusLink` makes it."""
        function = FUNCTIONS[name]._replace(**changes)
        self.calls[name] = call = Call(
            REQUESTS[name], function, self._motion_timeout if function.moves else REPLY_TIMEOUT,
            tries, self.now, poll, on_success)
        self.master.submit(call)
        return call

    def next_request(self):
        """The request to send now, or None."""
        return self.master.step(self.now)[0]

    def reply(self, *replies):
        """Receive replies in one read."""
        for reply in replies:
            wire = bus.encode_reply(reply)
            self.master.received(Frame(wire, reply.cmd1, 0, reply.data, reply), self.now)

    def later(self, seconds):
        self.now += seconds
        self.master.step(self.now, port_ready=False)

    def warnings(self, containing=''):
        return [record.getMessage() for record in self._caplog.records
                if record.levelno >= logging.WARNING and containing in record.getMessage()]

    def connect(self):
        """Connect to a board that answers SYNC, and the ECHO after it, at once."""
        self.master.connected(self.now)
        self.play('> SYNC; < SYNC;' + ('fence' if self._echoes else 'in step; +T; +0.001'))
        del self.begun_anew[:]
        return self

    def outcome(self, name):
        """The outcome of the latest call of that name."""
        return self.calls[name].outcome

    # -- scripts --------------------------------------------------------------------------------

    def play(self, script):
        for step in filter(None, map(str.strip, script.replace('\n', ' ').split(';'))):
            verb, _, rest = step.partition(' ')
            if verb in ('call', 'poll'):
                name, _, tries = rest.partition(' ')
                self.call(name, int(tries or 3), verb == 'poll')
            elif verb == '>':
                self._sends(rest, self.next_request(), step)
            elif verb == 'send':
                in_step, asked = self.master.state is SessionState.IN_STEP, self.next_request()
                if in_step and asked == bus.echo(self.nonces[-1]):
                    self.reply(bus.Reply(bus.ECHO, asked.data))
                    asked = self.next_request()
                self._sends(rest, asked, step)
            elif verb == 'fence':
                self.play('> ECHO; < ECHO; in step')
                assert self.master.state is SessionState.FENCED
            elif verb == '<':
                self.reply(*map(self._reply, rest.split()))
            elif verb in ('damaged', 'noise'):
                cause = CHECKSUM if verb == 'damaged' else FRAMING
                self.master.damaged(invalid_frame(b'\xa5\0\2\0', cause, verb), self.now)
            elif verb == 'missed':
                self.master.may_have_missed('the bridge stalled', self.now)
            elif verb[0] == '+':
                times = {'T': REPLY_TIMEOUT, 'M': self._motion_timeout}
                self.later(sum(times.get(each) or float(each) for each in verb[1:].split('+')))
            elif verb == 'connected':
                self.connect()
            elif verb == 'disconnected':
                self.master.disconnected(self.now, 'unplugged')
            elif verb == 'refused':
                self.master.not_sent('the port takes no data')
            elif verb == 'given':
                self.calls[rest.partition(' ')[2]].wait(0.0)
            elif step in ('in step', 'out of step', 'lost'):
                assert self.master.in_step == (step == 'in step'), step
                assert self.master.synchronised == (step != 'lost'), step
            else:
                assert rest.startswith('is '), f'{step} is no step'
                self._has(verb, rest[3:])

    def _sends(self, name, asked, step):
        expected = {'-': None, 'ECHO': bus.echo(self.nonces[-1]),
                    'SYNC': bus.SYNC_REQUEST}[name] if name.isupper() or name == '-' \
            else REQUESTS[name]
        assert asked == expected, f'{step}: {asked} was sent'

    def _reply(self, word):
        name, _, data = word.partition(':')
        if name == 'AIR':
            return AIR_REPLY
        if name in ('ECHO', '-ECHO'):
            nonce = self.nonces[-2 if name == '-ECHO' else -1]
            return bus.Reply(bus.ECHO, data.encode() or nonce)
        code = int(data or '0', 16)
        if name == 'INVALID':
            return bus.Reply(bus.INVALID, bytes((code,)))
        if name == 'ERROR':
            return bus.Reply(bus.ERROR, code.to_bytes(2, 'little'))
        return bus.Reply({'OK': bus.OK, 'SYNC': bus.SYNC}.get(name, 0x77), bytes.fromhex(data))

    def _has(self, name, words):
        outcome = self.outcome(name)
        if words == 'waiting':
            assert outcome is None, f'{name}: {outcome}'
        elif words == 'done':
            assert outcome and outcome.success, f'{name}: {outcome}'
        else:
            assert outcome and outcome.status == STATES[words], f'{name}: {outcome}'
            said = {'not sent': 'nothing was sent', 'not known': 'not known',
                    'invalid': 'nothing was executed'}.get(words, 'refused')
            assert said in outcome.message and not outcome.success


NO_ECHO = '> ECHO; +T;' * ECHO_TRIES + '> SYNC;'
LIFTS = 'call lift; send lift;'
AIRS = 'call air; send air; < AIR;'
MOVES = ('lift', 'gimbal', 'raw')
PROBES = (('air', 'AIR'), ('echo', 'ECHO:mine'), ('sync', 'SYNC'))
ANY_REPLIES = ('OK', 'SYNC', 'ERROR:8000', 'INVALID:40', 'ECHO:x')


@pytest.fixture
def fresh(caplog):
    """A session that was never connected."""
    return Session(caplog)


@pytest.fixture
def session(fresh):
    """A session that is connected, synchronised and in step."""
    return fresh.connect()


@pytest.fixture
def without_echo(caplog):
    """A session with bus/echo: false that is connected, synchronised and in step."""
    return Session(caplog, echoes=False).connect()


def table(*rows):
    """Tests as (what they show, script). IT in a script stands for each request, or pair of a
    request and its REPLY, of a third column; the fourth says where the session begins."""
    cases = []
    for title, script, *more in rows:
        for each in more[0] if more else ('',):
            it, answer = each if isinstance(each, tuple) else (each, '')
            cases.append(pytest.param(script.replace('IT', it).replace('REPLY', answer),
                                      id=f'{title} ({it}{answer and " "}{answer})' if it
                                      else title))
    return pytest.mark.parametrize('script', cases)


# -- rules 1 to 4: the order, timeouts, and which requests are sent again -------------------------

@table(
    ('one request at a time',
     'call lift; call gimbal; send lift; send -; +1; send -; < OK; lift is done;'
     'gimbal is waiting; send gimbal; < OK; gimbal is done; > -'),
    ('calls go in order, and before polls',
     'call raw; send raw; poll air; call lift; call gimbal; call echo; < OK; send lift; < OK;'
     'send gimbal; < OK; send echo; < ECHO:mine; send air; < AIR; > -'),
    ('a reconnect begins with SYNC, and an ECHO before any call',
     f'{LIFTS} disconnected; > -; connected; call air; > air'),
    ('without a reply a move is unknown and not sent again',
     'call IT; send IT; +T+-0.001; IT is waiting; +M; IT is not known; fence; > -', MOVES),
    ('a repeatable request is tried three times',
     'call IT;' + 'IT is waiting; send IT; +T; fence;' * 3 + 'IT is not known; > -',
     [name for name, _ in PROBES]),
    ('a repeated request can succeed',
     'call IT 2; send IT; +T; fence; send IT; < REPLY; IT is done',
     PROBES),
    ('it is sent again after INVALID "checksum", before the next call',
     'call IT; call custom;' + 'send IT; < INVALID:40; fence;' * 2
     + 'IT is waiting; > IT; < OK; IT is done; in step', MOVES),
    ('an error to the ECHO after an INVALID is not the reply to the request',
     'call IT; send IT; < INVALID:40; > ECHO; < ERROR:8000; IT is waiting; > -; < ECHO; > IT;'
     '< OK; IT is done', MOVES),
    ('an OK between the replies to SYNC and to the ECHO makes the outcome unknown',
     'call IT 1; send IT; < INVALID:10; > SYNC; < SYNC; IT is waiting; > ECHO; < OK;'
     'IT is not known', MOVES),
    ('an INVALID that no ECHO or SYNC confirms is not reported as a refusal',
     'call IT; send IT; < INVALID:40; > ECHO; disconnected; IT is not known;'
     'connected; call IT; send IT; < INVALID:10; > SYNC; disconnected; IT is not known;'
     'connected; call IT; send IT; < INVALID:40; > ECHO; +T; > ECHO; +M; IT is not known', MOVES),
    ('to a board that is not synchronised it is sent again after SYNC',
     'call IT; send IT; < INVALID:10; lost; > SYNC; +0.25; < SYNC; fence; > IT; < OK; IT is done',
     MOVES),
    ('a move that is sent again is not repeated after a timeout',
     f'{LIFTS} < INVALID:40; fence; > lift; +M; lift is not known; fence; > -'),
    ('a call is sent before a repeated poll',
     'poll air; > air; call lift; +T; fence; > lift; < OK; lift is done; send air'),
    ('a repeated poll is sent before another one',
     'poll read; > read; poll other; +T; fence; > read; < OK:0102; send other'),
    ('a repeatable request is sent again after INVALID "checksum"',
     'call IT; send IT; < INVALID:40; fence; > IT; < REPLY; IT is done', PROBES),
    ('what an INVALID ended is refused once an ECHO has returned',
     'call IT 1; send IT; < INVALID:40; IT is waiting; fence; > -; IT is invalid;'
     'call IT; send IT; < INVALID:20; IT is waiting; > ECHO; disconnected; IT is not known',
     (*MOVES, *(name for name, _ in PROBES))),
    ('a poll is sent again after INVALID "checksum"',
     'poll air; > air; < INVALID:40; fence; > air; < AIR; air is done'),
    ('and after INVALID "not synchronised" and a SYNC',
     'call IT; send IT; < INVALID:10; > SYNC; < SYNC; fence; > IT; < REPLY; IT is done', PROBES),
    ('a repeatable call is sent again though an OK follows the INVALID',
     'call twice 2; > twice; < INVALID:40; > ECHO; < OK; twice is waiting; < ECHO; > twice; < OK;'
     'twice is done'),
)
def test_what_is_sent(session, script):
    session.play(script)


def test_an_outcome_has_the_data_of_the_reply(session):
    session.play('call air; send air; < AIR; call air; send air; +0.125; < AIR')
    outcome = session.outcome('air')
    assert (outcome.status, outcome.data, outcome.error_code) == (bus.OK, AIR_REPLY.data, 0)
    assert outcome.success and outcome.round_trip == pytest.approx(0.125)
    assert list(session.master.round_trips) == pytest.approx([0.0, 0.125])


@pytest.mark.parametrize('name', MOVES)
@pytest.mark.parametrize('reply', ['INVALID:20', 'INVALID:77', 'ERROR:8000', 'ERROR:8001',
                                   'ERROR:8002'])
def test_a_refusal_is_reported_with_its_code_and_not_repeated(session, name, reply):
    kind, code = reply.split(':')
    session.play(f'call {name}; send {name}; < {reply};' + (
        f'{name} is waiting; fence; > -; {name} is invalid' if kind == 'INVALID' else
        f'{name} is refused') + '; > -; in step')
    assert session.outcome(name).error_code == int(code, 16)
    assert bus.describe_error(int(code, 16)) in session.outcome(name).message


# -- rule 6: out of step ----------------------------------------------------------------------

@table(
    ('nothing is sent before the ECHO returns',
     f'{LIFTS} +M+-1; call gimbal; +1; > ECHO; lift is not known;'
     '< OK SYNC ERROR:8002 AIR ECHO:no OK:6e303032; > -; out of step; < ECHO; > gimbal'),
    ('only ECHOs that are unanswered in a row make a SYNC necessary',
     f'noise; > ECHO; +T; fence; noise; {NO_ECHO}'),
    ('an ECHO of an earlier nonce is dropped',
     'call raw; send raw; +T; > ECHO; +T; > ECHO; < -ECHO; out of step; > -; < ECHO; in step'),
    ('an ECHO that gets INVALID is sent again with a new nonce',
     'noise; > ECHO; < INVALID:40 INVALID:20; > -; +T; > ECHO; < -ECHO; > -; < ECHO; in step'),
    ('an ECHO to a board that is not synchronised is followed by SYNC and an ECHO',
     'noise; > ECHO; < INVALID:10; > SYNC; < SYNC; fence'),
    ('SYNC and refused ECHOs alternate not faster than ECHOs time out',
     'noise;' + '> ECHO; < INVALID:10; > SYNC; < SYNC;' * ECHO_TRIES
     + '> ECHO; < INVALID:10; > -; +T; > SYNC; < SYNC; fence'),
    ('INVALID "not synchronised" without a request leads to SYNC',
     '< INVALID:10; lost; call lift; > SYNC; < SYNC; fence; > lift; lift is waiting'),
    ('a reply without a request leads to an ECHO',
     '< IT; out of step; call lift; fence; > lift', ANY_REPLIES),
    ('after a damaged reply the outcome is unknown',
     'call IT; call air; send IT; damaged; IT is not known; fence; > air; air is waiting', MOVES),
    ('a repeatable request is sent again after a damaged reply',
     'call IT; send IT; damaged; IT is waiting; fence; > IT; < REPLY; IT is done', PROBES),
    ('a reply after noise is taken',
     'call IT; send IT; noise; IT is waiting; < OK; IT is done; call custom; fence; > custom',
     MOVES),
    ('ECHO is tried again after a SYNC, for ever',
     f'noise; {NO_ECHO} < SYNC;' + '> ECHO; +T; > SYNC; < SYNC;' * 5 + 'call lift; fence; > lift'),
    ('a board that answers neither ECHO nor SYNC is not synchronised',
     f'noise; {NO_ECHO} +T; lost; > SYNC; < SYNC; fence'),
    ('no other reply is taken for the reply to the SYNC after ECHOs',
     f'noise; {NO_ECHO} IT; lost; > -; < SYNC; fence',
     ('< OK', '< INVALID:10', '< INVALID:40', 'noise', 'missed')),
    ('after a stall nothing is sent before an ECHO returns',
     'missed; call air; fence; > air; < AIR; air is done'),
    ('calls that wait are not given up early while a reply may follow noise',
     f'{LIFTS} noise; call raw; +1; raw is waiting; < OK; lift is done; fence; > raw'),
    ('a call succeeds if its reply arrives after a stall',
     'call IT; send IT; missed; < OK; IT is done; fence', MOVES),
    ('the outcome is unknown if the reply was dropped in a stall',
     'call IT; send IT; missed; +M; IT is not known; fence; > -', MOVES),
    ('a reading is requested again after a stall',
     'call air; send air; missed; +T; fence; > air; < AIR; air is done'),
)
def test_out_of_step(session, script):
    session.play(script)


def test_every_nonce_is_new(session):
    session.play('call raw; send raw; +T;' + '> ECHO; +T;' * ECHO_TRIES)
    assert len(set(session.nonces)) == len(session.nonces)
    machine = Master(REPLY_TIMEOUT, MOTION_TIMEOUT, SparingLog('bus', logging.getLogger('x')))
    seen = set()
    for _ in range(20):
        machine.connected(0.0)
        machine.step(0.0)
        machine.received(Frame(b'', 0, 0, b'', bus.Reply(bus.SYNC)), 0.0)
        seen.add(machine.step(0.0)[0].data)
        machine.disconnected(0.0, '')
    assert len(seen) == 20 and {len(nonce) for nonce in seen} == {4}


# -- rule 6: the fence --------------------------------------------------------------------------

@table(
    ('SYNC and ECHO need no fence',
     f'{LIFTS} < OK;' + 'call IT; > IT; < REPLY;' * 2, PROBES[1:]),
    ('a call has a fence even after the same request',
     'call IT; > IT; < REPLY;' + 'call IT; fence; > IT; < REPLY;' * 2,
     (('air', 'AIR'), ('read', 'OK:0102'), ('custom', 'OK'), ('lift', 'OK'), ('raw', 'OK'))),
    ('a poll has a fence unless it follows the same poll',
     'poll read; > read; < OK:0102; poll read; > read; < OK:0102; poll other; fence; > other;'
     '< OK:0102; poll other; > other; < OK:0102; poll read; fence; > read; < OK:0102; poll air;'
     'fence; > air; < AIR; poll air; > air'),
    ('another exchange between two polls makes a fence necessary',
     'poll read; > read; < OK:0102; call IT; > IT; < REPLY; poll read; fence; > read', PROBES[1:]),
    ('a call of the same request between two polls does not',
     'poll read; > read; < OK:0102; call read; fence; > read; < OK:0102; poll read; > read'),
    ('for a reading a fence lasts until the next exchange', '+3600; call IT; > IT',
     ('air', 'read')),
    ('a new poll waits for the move after the fence',
     f'{AIRS} call lift; > ECHO; poll air; +0.001; < ECHO; > lift; < OK; send air'),
    ('a call sent between fence and move makes another one necessary',
     'call air; call lift; > air; < AIR; > ECHO'),
    ('a doubled echo is not taken for the reply to the request',
     f'{AIRS} call IT; > ECHO; < ECHO; > IT; < ECHO; IT is waiting; < OK; IT is done; fence',
     MOVES),
    ('a damaged or lost fence is sent again with a new nonce',
     f'{AIRS} call lift; > ECHO; damaged; > -; lift is waiting; +T; > ECHO; < -ECHO; > -; < ECHO;'
     '> lift'),
    ('a fence to a reset board is followed by SYNC and a new fence',
     f'{AIRS} call lift; > ECHO; < INVALID:10; > SYNC; < SYNC; fence; > lift; < OK; lift is done'),
)
def test_fences(session, script):
    session.play(script)


# -- rule 6: a board that does not echo ----------------------------------------------------------


@table(
    ('a silence is the fence of each call',
     '+0.021; call IT; > IT; < REPLY; call lift; > -; +0.019; > -; +0.002; > lift; < OK;'
     'lift is done; call lift; > -; +0.021; > lift', PROBES[1:]),
    ('what needs no fence needs no silence', '+0.02;' + 'call IT; > IT; < REPLY;' * 3, PROBES[1:]),
    ('the same poll needs no silence', '+0.021;' + 'poll air; > air; < AIR;' * 3),
    ('another reading waits for a silence',
     '+0.021; call air; > air; < AIR; IT; > -; +0.021; > REPLY',
     (('call air', 'air'), ('call read', 'read'), ('poll read', 'read'))),
    ('an OK with data that is not expected is not taken',
     '+0.021; call IT; > IT; < AIR; IT is waiting; out of step; +M; IT is not known',
     ('lift', 'gimbal', 'custom')),
    ('the right reply may follow one with unexpected data',
     '+0.021; call lift; > lift; < ECHO:late; < AIR; lift is waiting; < OK; lift is done'),
    ('the right reply may follow one of a wrong length',
     '+0.021; call two; > two; < OK; two is waiting; < OK:6162; two is done'),
    ('a SYNC and a silence are the way back in step',
     '+0.021; IT; call lift; > SYNC; < OK; > -; < SYNC; in step; > -; +0.49; > -; +0.02; > lift',
     ('call raw; > raw; +M', 'call raw; > raw; damaged', 'noise', '< OK', 'missed')),
    ('a SYNC without an answer is repeated',
     'noise; > SYNC; +T; lost; > SYNC; < SYNC; +0.51; call lift; > lift'),
    ('what is received in the silence needs another SYNC',
     'noise; > SYNC; < SYNC; call lift; +0.3; IT; > SYNC; < SYNC; +0.49; > -; +0.02; > lift',
     ('< OK', '< SYNC', 'noise')),
    ('after an INVALID a move is not known, and not sent again: no ECHO tells what it was for',
     '+0.021; call IT; > IT; < REPLY; IT is not known; > SYNC; < SYNC; +0.51; > -',
     [(name, reply) for name in MOVES for reply in ('INVALID:40', 'INVALID:20')]),
    ('what is repeatable is sent again, and then not known',
     '+0.021; call air;' + '> air; < INVALID:40; > SYNC; < SYNC; +0.51;' * 3 + 'air is not known'),
    ('a stop is sent again after a SYNC and a silence',
     '+0.021; call lift; > lift; call stop; > stop; lift is not known; > SYNC; +T; > stop; > SYNC;'
     '< OK SYNC; > -; stop is waiting; +0.51; > stop; < OK; stop is done'),
)
def test_without_echo(without_echo, script):
    without_echo.play(script)


# -- rule 5: data in an OK ------------------------------------------------------------------------

@pytest.mark.parametrize('name', ['lift', 'gimbal', 'custom'])
@pytest.mark.parametrize('reply', ['OK:00', 'AIR'])
def test_an_ok_with_unexpected_data_is_taken_behind_a_fence(session, name, reply):
    session.play(f'call {name}; send {name}; < {reply}; {name} is done;' * 2 + 'in step')
    assert session.outcome(name).data == session._reply(reply).data


# -- rule 7: the port closes, callers that wait or give up -----------------------------------------

@table(
    ('the outstanding call is unknown, the others are not sent',
     'call IT; call custom; poll air; send IT; disconnected; IT is not known; custom is not sent;'
     'air is not sent', MOVES),
    ('no earlier call is sent after a reconnect',
     f'{LIFTS} call gimbal; IT disconnected; connected; > -', ('+0;', '')),
    ('a call submitted just before the closing is refused',
     'call lift; disconnected; lift is not sent'),
    ('a request that the port refused is not sent', f'{LIFTS} refused; lift is not sent; > -'),
    ('a repeated request that the port refused was sent before',
     'call air; send air; +T; fence; > air; refused; air is not known'),
    ('a repeated request that waits was sent before',
     'call air; send air; +T; disconnected; air is not known'),
    ('a call waits for the motion before it',
     f'{LIFTS} call raw; +M+-0.1; raw is waiting; < OK; send raw'),
    ('a queued call expires without being sent',
     f'{LIFTS} +1; call gimbal; call raw; < OK; send gimbal; +M; raw is not sent;'
     'gimbal is not known; fence; > -'),
    ('a call whose caller has given up is not sent',
     f'{LIFTS} call IT; given up IT; < OK; > -; IT is not sent', ('gimbal', 'raw')),
    ('nor sent again', f'{LIFTS} given up lift; lift is not known; < INVALID:40; fence; > -'),
    ('nor is a fence sent for it', 'call air; > air; call lift; < AIR; +0; given up lift; > -'),
)
def test_the_outcome_is_true(session, script):
    session.play(script)


# -- rule 8: calls that interrupt -----------------------------------------------------------------

@table(
    ('a stop is sent during a move, whose outcome is then unknown',
     # The board answers the move, which has just ended or was stopped, and this stop; neither is
     # taken for the reply to a request that has a reply of its own.
     f'{LIFTS} +1; call stop; > stop; lift is not known; < OK OK; stop is waiting; fence; > stop;'
     '< OK; stop is done; > -'),
    ('it is not successful before the board answers it behind a fence',
     f'{LIFTS} call stop; > stop; fence; > stop; < ERROR:8000; stop is refused'),
    ('it is sent again with each ECHO until the board answers',
     f'{LIFTS} call stop;' + '> stop; > ECHO; +T;' * ECHO_TRIES + '> stop; > SYNC; stop is waiting;'
     '+M; stop is not known; > SYNC'),
    ('one that the port did not take is sent later',
     f'{LIFTS} call stop; > stop; refused; > stop; disconnected; stop is not known'),
    ('one that was sent at once never counts as not sent',
     f'{LIFTS} call stop; > stop; given up stop; stop is not known'),
    ('calls that wait are not sent',
     f'{LIFTS} call gimbal; poll air; call raw; call stop; call custom; > stop; gimbal is not sent;'
     'air is not sent; raw is not sent; custom is waiting'),
    ('a stop takes the place of a move that waits for its fence',
     f'{AIRS} call lift; > ECHO; call stop; > stop; lift is not sent; out of step; > ECHO;'
     '< -ECHO OK; stop is waiting; > -; < ECHO; > stop; < OK; stop is done'),
    ('an ECHO that a stop ends does not count as unanswered',
     LIFTS + 'call stop; > stop; > ECHO;' * (ECHO_TRIES + 1)),
    ('a stop is sent to a board that does not answer ECHO, and again with each ECHO and SYNC',
     f'noise; {NO_ECHO} call stop; > stop; lost; > SYNC; < SYNC; > ECHO; +T; > stop; > SYNC; +T;'
     '> stop; > SYNC; < SYNC; fence; > stop; < OK; stop is done'),
    ('a stop is sent while a move with an unknown outcome may last',
     f'{LIFTS} +M; > ECHO; call stop; > stop'),
    ('a stop that timed out is sent again before later calls',
     'call stop; > stop; fence; > stop; call lift; +T; fence; > stop; < OK; stop is done;'
     'send lift'),
)
def test_stops(session, script):
    session.play(script)


# -- the table -------------------------------------------------------------------------------------

def test_the_table_has_a_row_for_every_event_in_every_state():
    assert {kind: set(rows) for kind, rows in TRANSITIONS.items()} == {
        kind: set(Event) for kind in Kind}
