"""The Master's session as a state machine: every rule; the tests set the time."""
import logging
from dataclasses import replace

import pytest

from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.call import NOT_READY_WAIT, Call
from serial_communication.boards.bus.master import FENCE_AGE, FENCE_SILENCE, Master
from serial_communication.boards.bus.session import (ECHO_TRIES, TRANSITIONS, Condition, Event,
                                                     Kind, SessionState)
from serial_communication.framing.layout import Layout, Value
from serial_communication.framing.rows import BOARD
from serial_communication.framing.stream import CHECKSUM, FRAMING, Frame, invalid_frame
from serial_communication.link.outcome import NOT_SENT, TIMEOUT, Outcome
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
    stop=replace(FUNCTIONS['stop'], repeatable=True, interrupts=True),
    read=replace(FUNCTIONS['read'], repeatable=True, reply=TWO_BYTES),
    other=replace(FUNCTIONS['other'], repeatable=True, reply=TWO_BYTES),
    twice=replace(FUNCTIONS['twice'], repeatable=True),
    two=replace(FUNCTIONS['two'], reply=Layout('<2x', ())),
    own=replace(FUNCTIONS['own'], origin=BOARD),
    ownstop=replace(FUNCTIONS['ownstop'], repeatable=True, interrupts=True, origin=BOARD))
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
        function = replace(FUNCTIONS[name], **changes)
        self.calls[name] = call = Call(
            REQUESTS[name], function, self._motion_timeout if function.moves else REPLY_TIMEOUT,
            tries, self.now, poll, on_success)
        self.master.submit(call)
        return call

    def next_request(self):
        """The request to send now, or None."""
        return self.master.step(self.now)[0]

    def wake_at(self):
        """When the Master has to be called again at the latest; nothing is sent."""
        return self.master.step(self.now, port_ready=False)[1]

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


@pytest.mark.parametrize('reply', ['OK', 'INVALID:40', 'INVALID:10', 'ERROR:8000', 'ECHO:x', '?'])
def test_no_other_reply_is_taken_for_the_reply_to_sync(fresh, reply):
    fresh.master.connected(fresh.now)
    fresh.play(f'> SYNC; < {reply}; lost')
    assert fresh.next_request() in (None, bus.SYNC_REQUEST)


def test_only_sync_is_sent_until_it_is_answered(fresh):
    fresh.call('lift')
    fresh.play('> -; +0.8; lift is not sent')
    assert 'closed' in fresh.outcome('lift').message
    fresh.master.connected(fresh.now)
    fresh.play('> SYNC; > -; +T;' * 7 + 'call lift; > SYNC; lost')
    assert fresh.master.condition() is Condition.NO_SYNC
    fresh.play('< SYNC; fence; > lift; < OK; lift is done')


def test_an_outcome_has_the_data_of_the_reply(session):
    session.play('call air; send air; < AIR; call air; send air; +0.125; < AIR')
    outcome = session.outcome('air')
    assert (outcome.status, outcome.data, outcome.error_code) == (bus.OK, AIR_REPLY.data, 0)
    assert outcome.success and outcome.round_trip == pytest.approx(0.125)
    assert list(session.master.round_trips) == pytest.approx([0.0, 0.125])


@pytest.mark.parametrize('name', MOVES)
@pytest.mark.parametrize('answer', ['< OK', 'damaged', 'missed'])
@pytest.mark.parametrize('code', [0x40, 0x20, 0x10])
def test_an_ok_after_an_invalid_makes_the_outcome_unknown(session, name, answer, code):
    """Either the INVALID was for noise and the OK is the reply, or the OK is a doubled reply to an
    earlier request. Neither "refused" nor "success" is safe then, nor is another try."""
    session.play(f'call {name}; send {name}; < INVALID:{code:x}; {name} is waiting;'
                 f'> {"SYNC" if code == 0x10 else "ECHO"}; {answer}; {name} is not known; > -')
    assert session.outcome(name).error_code == code
    session.play('< SYNC; > ECHO; < ECHO; > -' if code == 0x10 else '< ECHO; in step; > -')


@pytest.mark.parametrize('code', [0x40, 0x20])
def test_a_repeatable_call_is_refused_only_if_no_ok_follows_the_invalid(session, code):
    session.play(f'call twice 1; > twice; < INVALID:{code:x}; twice is waiting; > ECHO; < OK ECHO;'
                 'twice is not known')
    assert session.outcome('twice').error_code == code


@pytest.mark.parametrize('name', MOVES)
@pytest.mark.parametrize('code, again', [
    (0x40, ''), (0x10, '> SYNC; < SYNC;')], ids=('checksum', 'not synchronised'))
def test_a_request_that_always_gets_invalid_is_refused_after_its_tries(session, name, code, again):
    session.play(f'call {name} 3;' + f'send {name}; < INVALID:{code:x}; {again} fence;' * 3
                 + f'> -; {name} is invalid')
    assert session.outcome(name).error_code == code


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


def test_a_late_reply_to_an_earlier_sync_is_not_returned_to_a_caller(fresh):
    """Two SYNCs were sent, and both replies are late: the second has no request."""
    fresh.master.connected(fresh.now)
    fresh.play('> SYNC; +T; > SYNC; +0.1; < SYNC; call sync; > ECHO; < SYNC; sync is waiting')


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


@pytest.mark.parametrize('name, foreign', [
    ('lift', 'SYNC'), ('lift', 'ECHO:n000'), ('gimbal', '?'), ('air', 'SYNC'), ('air', 'ECHO:air'),
    ('raw', 'SYNC'), ('raw', 'ECHO:raw'), ('raw', '?'), ('echo', 'ECHO:ours'), ('echo', 'OK'),
    ('sync', 'OK')])
def test_a_reply_that_does_not_fit_the_request_is_not_returned(session, name, foreign):
    session.play(f'call {name}; send {name}; < {foreign}; {name} is waiting; out of step')
    assert session.master.outstanding_call is session.calls[name]


@pytest.mark.parametrize('name', MOVES)
@pytest.mark.parametrize('code', [0x40, 0x10, 0x20])
def test_after_a_stall_an_invalid_makes_the_outcome_unknown(session, name, code):
    session.play(f'call {name}; send {name}; missed; < INVALID:{code:x}; {name} is not known;'
                 + ('lost' if code == 0x10 else 'out of step'))
    assert session.outcome(name).error_code == code


def test_a_bad_line_is_logged_sparingly(session):
    session.play('noise; fence;' * 100)
    assert len(session.warnings('out of step: received bytes that are no valid reply')) == 1


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


@pytest.mark.parametrize('name', MOVES)
@pytest.mark.parametrize('before, answer', [
    ('lift', 'OK'), ('raw', 'OK'), ('air', 'AIR'), ('sync', 'SYNC'), ('echo', 'ECHO:mine'),
    ('lift', 'ERROR:8002')])
def test_before_a_move_or_a_raw_request_a_new_echo_returns(session, name, before, answer):
    """The ECHO behind the SYNC was a fence already for the exchange before."""
    session.play(f'call {before}; > {before}; < {answer}; call {name}; > ECHO; > -; < ECHO;'
                 f'> {name}')


@pytest.mark.parametrize('name', MOVES)
def test_a_doubled_reply_before_the_fence_returns_is_dropped(session, name):
    session.play(f'{LIFTS} < OK; call {name}; > ECHO; < OK ECHO; > {name}; < ERROR:8002;'
                 f'{name} is refused')
    assert len(session.warnings('out of step: OK to ECHO')) == 1, 'the doubled reply is logged'


@pytest.mark.parametrize('name', ['lift', 'gimbal', 'raw', 'custom'])
def test_before_a_move_a_fence_is_renewed_after_1_s(session, name):
    """Rule 10: the other side may stand meanwhile, and would deliver the move when it goes on."""
    session.later(FENCE_AGE - 0.01)
    session.play(f'call {name}; > {name}; < OK; call echo; > echo; < ECHO:mine; call {name}; fence')
    session.later(FENCE_AGE + 0.01)
    session.play(f'> ECHO; +0.8; +M; {name} is not sent')


# -- rule 6: a board that does not echo ----------------------------------------------------------

def test_after_three_unanswered_echoes_no_call_is_sent_until_one_returns(fresh):
    """bus/echo is true: one line names it, and all calls get NOT_SENT."""
    fresh.master.connected(fresh.now)
    fresh.play('> SYNC; < SYNC; > ECHO; +T; > ECHO; +T; > ECHO')
    assert fresh.master.condition() is Condition.OUT_OF_STEP and not fresh.warnings('bus/echo')
    fresh.play('+T')
    for _ in range(4):
        assert fresh.master.condition() is Condition.NO_ECHO
        for name in MOVES + ('air',):
            fresh.call(name)
        fresh.play('> SYNC; < SYNC; > ECHO; +T; > SYNC; < SYNC; > ECHO; +T; lift is not sent;'
                   'gimbal is not sent; raw is not sent; air is not sent')
    assert 'bus/echo' in fresh.outcome('lift').message
    assert len(fresh.warnings()) == 1 and fresh.warnings('set bus/echo to false')
    fresh.play('call lift; > SYNC; < SYNC; fence; > lift; < OK; lift is done')
    assert fresh.master.condition() is Condition.READY


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


@pytest.mark.parametrize('name', MOVES)
def test_without_echo_a_move_waits_for_a_silence_since_the_last_byte(without_echo, name):
    session = without_echo
    session.play('+0.021; call air; > air; +0.1; < AIR')
    session.call(name)
    assert session.master.step(session.now) == (None, pytest.approx(session.now + FENCE_SILENCE))


def test_without_echo_any_byte_ends_the_silence(without_echo):
    session = without_echo
    session.play('+0.021; call air; > air; < AIR; +0.1')
    session.master.bytes_came(session.now)      # of what is no frame, and may go on
    session.call('lift')
    assert session.master.step(session.now) == (None, pytest.approx(session.now + FENCE_SILENCE))


# -- rule 5: data in an OK ------------------------------------------------------------------------

@pytest.mark.parametrize('name', ['lift', 'gimbal', 'custom'])
@pytest.mark.parametrize('reply', ['OK:00', 'AIR'])
def test_an_ok_with_unexpected_data_is_taken_behind_a_fence(session, name, reply):
    session.play(f'call {name}; send {name}; < {reply}; {name} is done;' * 2 + 'in step')
    assert session.outcome(name).data == session._reply(reply).data


def test_a_timeout_says_which_other_reply_was_received(without_echo):
    without_echo.play('+0.021; call lift; > lift; < AIR; +M; lift is not known')
    assert f'{AIR_REPLY}' in without_echo.outcome('lift').message
    assert without_echo.warnings('no reply to "lift up 100 mm" within 5 s but OK')


@pytest.mark.parametrize('data', [b'', bytes(4), bytes(7)], ids=len)
@pytest.mark.parametrize('poll', [False, True], ids=('call', 'poll'))
def test_a_reply_of_a_wrong_length_is_reported_at_once(session, data, poll):
    """A poll without a fence is sent once more after the ECHO: the reply may be another's."""
    wrong = f'< OK:{data.hex()};'
    session.play(f'poll air; > air; < AIR; poll air; > air; {wrong} air is waiting; fence; > air;'
                 f'{wrong}' if poll else f'call air; > air; {wrong}')
    outcome = session.outcome('air')
    assert (outcome.success, outcome.status, outcome.data) == (False, bus.OK, data)
    assert f'{len(data)} bytes' in outcome.message and '6 were expected' in outcome.message
    assert session.master.timeouts == 0
    assert session.master.data_errors == {'length': 1 + poll}
    assert len(session.warnings()) == 1
    session.play('call air; fence')


def test_a_reply_with_impossible_values_is_reported_and_counted(session):
    layout = Layout('<B', [Value('level', maximum=100)])
    for data, success in (('64', True), ('65', False)):
        call = session.call('custom', reply=layout)
        session.play(f'send custom; < OK:{data}')
        assert call.outcome.status == bus.OK and call.outcome.success == success
    assert 'level is 101, above the maximum of 100' in call.outcome.message
    assert session.master.data_errors == {'implausible': 1}


@pytest.mark.parametrize('reply, is_valid', [('AIR', True), ('OK', False), ('ERROR:8000', False)])
def test_on_success_is_called_with_a_valid_reading_only(session, reply, is_valid):
    readings = []
    session.call('air', tries=1, poll=True, on_success=readings.append)
    session.play(f'> air; < {reply}')
    assert [outcome.data for outcome in readings] == ([AIR_REPLY.data] if is_valid else [])


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


def test_the_outcome_of_a_request_sent_while_its_caller_gives_up_is_not_known():
    call = Call(REQUESTS['lift'], bus.LIFT_FUNCTION, 1.0, 1, 0.0)
    lock = call._lock

    class ClaimedFirst:
        """The link's thread holds the lock before the caller does."""

        def __enter__(self):
            call._lock = lock
            assert call.claim()
            lock.acquire()

        def __exit__(self, *_):
            lock.release()

    call._lock = ClaimedFirst()
    outcome = call.wait(0.0)
    assert outcome.status == TIMEOUT and 'not known' in outcome.message
    assert call.outcome is outcome


def test_only_the_first_outcome_counts():
    call = Call(REQUESTS['lift'], bus.LIFT_FUNCTION, 1.0, 1, 0.0)
    first, second = (Outcome(status, '') for status in (NOT_SENT, bus.OK))
    call.finish(first)
    call.finish(second)
    assert call.wait(0.0) is first
    assert not call.claim() and not call.claim_at_once()


# -- how long a call waits ------------------------------------------------------------------------

def test_a_call_to_a_board_that_never_synchronises_expires_soon(fresh):
    fresh.master.connected(fresh.now)
    fresh.play('> SYNC; call lift; +0')
    assert fresh.wake_at() <= fresh.now + NOT_READY_WAIT
    fresh.play('+T; > SYNC; +0.8; lift is not sent')
    assert 'SYNC' in fresh.outcome('lift').message


@pytest.mark.parametrize('script, name, end', [
    ('call raw; send raw; +T; call custom', 'custom', 'not sent'),      # while it is out of step
    (f'{AIRS} call IT', 'lift', 'not sent'), (f'{AIRS} call raw', 'raw', 'not sent'),    # fences
    (f'{LIFTS} +M; call raw', 'raw', 'not sent'),
    ('call raw; send raw; +T+-0.1; < INVALID:40', 'raw', 'not known')])
def test_a_call_ends_within_its_timeout_and_a_second(session, script, name, end):
    """While nothing is answered; nothing but ECHO and SYNC is sent meanwhile."""
    session.play(script.replace('IT', name))
    call = session.calls[name]
    while call.outcome is None:
        asked = session.next_request()
        assert asked is None or asked.cmd1 in (bus.ECHO, bus.SYNC)
        session.now = session.wake_at()
        session.later(0.0)
    session.play(f'{name} is {end}')
    assert session.now - call.submitted <= call.timeout + 1.0


def test_the_deadline_is_that_of_the_request_or_of_a_waiting_call(session):
    session.play('call raw; send raw; call lift')
    assert session.wake_at() == pytest.approx(session.now + REPLY_TIMEOUT)


TWO_MOVES = 'call gimbal; call lift; call raw; send gimbal; +1; < OK; send lift;'


@pytest.mark.parametrize('script, why', [
    ('call raw', 'the link waits for the rest of an incomplete frame'),
    (TWO_MOVES, 'the bus is busy with other calls'), (TWO_MOVES + 'noise', 'out of step')])
def test_a_call_that_waits_is_told_what_for(session, script, why):
    session.play(script)
    session.now = session.calls['raw'].submitted + MOTION_TIMEOUT
    assert session.master.step(session.now, 'the rest of an incomplete frame')[0] is None
    assert session.outcome('raw') == (NOT_SENT, f'{why}; nothing was sent', 0, b'', 0.0, True, None)


def test_at_the_closing_every_call_is_told_so(session):
    session.play('call lift; call stop; disconnected; lift is not sent; stop is not sent')
    assert 'the port is closed' in session.outcome('lift').message


def test_the_condition_says_why_calls_are_not_served(fresh):
    for script, condition in (('', Condition.SYNCHRONISING), ('connected', Condition.READY),
                              ('noise', Condition.OUT_OF_STEP), (NO_ECHO, Condition.NO_ECHO),
                              ('+T', Condition.NO_SYNC),
                              ('> SYNC; < SYNC', Condition.OUT_OF_STEP),
                              ('fence', Condition.READY)):
        fresh.play(script)
        assert fresh.master.condition() is condition
    assert not fresh.warnings('bus/echo'), 'a board that is off'


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


def test_a_stop_is_sent_before_the_board_answers_sync(fresh):
    fresh.master.connected(fresh.now)
    fresh.play('> SYNC; call stop; > stop; lost')
    assert fresh.master.condition() is Condition.SYNCHRONISING
    fresh.play('> SYNC; < SYNC; fence; > stop; < OK; stop is done')


@pytest.mark.parametrize('idle', [True, False], ids=('idle', 'moving'))
def test_a_stop_waits_for_nothing_that_is_received(session, idle):
    session.play('' if idle else LIFTS)
    session.play('call stop; call raw')
    held = 'the rest of an incomplete frame'
    assert session.master.step(session.now, held, port_ready=False)[0] is None
    assert session.master.step(session.now, held)[0] == REQUESTS['stop']
    assert session.master.step(session.now, held)[0] is None, 'all others wait'
    session.now += MOTION_TIMEOUT
    session.master.step(session.now, held)
    session.play('stop is not known; raw is not sent' + '; lift is not known' * (not idle))


def test_of_two_stops_both_have_an_outcome(session):
    session.play(LIFTS)
    stops = [session.call('stop'), session.call('stop')]
    session.play('> stop; > stop; fence; > stop; < OK; send stop; < OK')
    assert all(stop.outcome.success for stop in stops)


@pytest.mark.parametrize('name', MOVES)
@pytest.mark.parametrize('code', ['40', '10', '20'])
def test_after_noise_an_invalid_makes_the_outcome_unknown(session, name, code):
    """The noise may have been the OK, and the INVALID a reply to noise on the way to the board."""
    session.play(f'call {name}; send {name}; noise; < INVALID:{code}; {name} is not known;'
                 + ('> SYNC; < SYNC;' if code == '10' else '') + 'fence; > -')
    assert session.outcome(name).error_code == int(code, 16)


def test_a_reading_is_asked_for_again_after_noise_and_an_invalid(session):
    session.play('call air; send air; noise; < INVALID:40; air is waiting; fence; > air; < AIR;'
                 'air is done')


def test_a_repeatable_call_is_not_told_as_refused_after_an_ok(session, monkeypatch):
    monkeypatch.setitem(FUNCTIONS, 'own', replace(FUNCTIONS['own'], repeatable=True))
    session.announces = True
    session.play('call own; send own; < INVALID:10; > SYNC; < OK SYNC; fence; > -;'
                 'own is not known; call twice; send twice; < INVALID:40; > ECHO; < OK ECHO;'
                 '> twice; refused; twice is not known')


@pytest.mark.parametrize('script', [
    'call twice; send twice; < INVALID:40; > ECHO; < OK; < ECHO; send twice; < INVALID:40; fence;'
    'send twice; < INVALID:40; fence; > -; twice is not known',
    'call twice; send twice; damaged; > ECHO; < ECHO; send twice; < INVALID:20; fence; > -;'
    'twice is not known',
    'call twice; send twice; +T; > ECHO; < ECHO; send twice; < INVALID:20; fence; > -;'
    'twice is not known',
    'call stop; > stop; > ECHO; < OK ECHO; send stop; < INVALID:20; fence; > -; stop is not known'],
    ids=('an OK', 'a damaged reply', 'no reply', 'at once'))
def test_what_may_have_been_executed_before_is_not_told_as_refused(session, script):
    session.play(script)


def test_a_reply_behind_the_confirming_echo_needs_another_echo(session):
    session.play(f'{LIFTS} < INVALID:40; > ECHO; < ECHO OK; lift is not known; call gimbal; fence;'
                 '> gimbal')


def test_a_stop_is_sent_again_if_the_port_did_not_take_the_echo_behind_it(session):
    session.play(f'{LIFTS} call stop; > stop; > ECHO; refused; > stop; > ECHO')


# -- rules 9 and 10: what waited, or may still wait -----------------------------------------------

def test_after_a_stall_only_what_is_repeatable_is_sent(session):
    session.play(f'{LIFTS} call gimbal; call air; poll read; +0')
    session.call('raw')      # submitted during the stall
    session.master.stalled(session.now)
    session.play('gimbal is not sent; raw is not sent; air is waiting; lift is waiting; < OK;'
                 'lift is done; fence; > air; < AIR; send read')


def test_what_was_called_before_a_stall_and_submitted_after_it_is_not_sent(session):
    """The caller's thread stood between the two, and the link's thread goes on before it."""
    for name in ('lift', 'air'):
        session.calls[name] = Call(REQUESTS[name], FUNCTIONS[name], 1.0, 1, session.now)
    session.now += 0.4
    session.master.stalled(session.now)
    for call in session.calls.values():
        session.master.submit(call)
    session.play('fence; > air; < AIR; lift is not sent; +0.5; call gimbal;'
                 'send gimbal')


@pytest.mark.parametrize('stall', [0.9, MOTION_TIMEOUT + 1.0])
def test_a_stop_that_waited_during_a_stall_is_sent_however_long_it_was(session, stall):
    session.play(f'{LIFTS} call stop')
    session.now += stall
    session.master.stalled(session.now)
    held = 'the end of the bytes that waited during a stall'
    assert session.master.step(session.now, held)[0] == REQUESTS['stop']
    session.play('lift is not known')


def test_output_is_dropped_if_a_move_that_a_stop_ended_is_not_answered(session):
    session.play(LIFTS)
    sent = session.now
    session.play('+1; call stop; > stop')
    while not session.dropped and session.now < sent + 2 * MOTION_TIMEOUT:
        while session.next_request():
            pass
        session.later(0.1)
    assert session.dropped == [sent]
    assert MOTION_TIMEOUT <= session.now - sent < MOTION_TIMEOUT + REPLY_TIMEOUT + 0.2
    assert session.next_request() == REQUESTS['stop'], 'it may have been dropped, too'


def test_output_is_not_dropped_after_a_stop_if_the_port_was_opened_since(session):
    session.play(f'{LIFTS} +1; call stop; > stop; disconnected; connected; call raw; > raw; +M;'
                 '> ECHO; +M')
    assert len(session.dropped) == 1, 'that of the raw request'


@pytest.mark.parametrize('name', ['lift', 'gimbal', 'raw', 'custom', 'air', 'read'])
def test_output_is_dropped_if_a_move_is_not_answered(session, name):
    session.play(f'call {name} 1; send {name}')
    sent = session.now
    session.later(MOTION_TIMEOUT)
    assert session.dropped == ([] if name in ('air', 'read') else [sent])


# -- rule 12: another board behind the same port ---------------------------------------------------

def test_an_announced_function_is_sent_only_to_a_board_that_has_announced_it(session):
    session.play('call own; > -')
    assert session.outcome('own')[:2] == (
        NOT_SENT, 'the board may have begun anew, and has not announced this function since; '
        'nothing was sent')
    assert session.begun_anew == []
    session.announces = True
    session.play('call own; send own')


@pytest.mark.parametrize('before, reply', [
    ('', 'INVALID:10'), ('call own; send own;', 'INVALID:10'), ('missed; > ECHO;', 'INVALID:10'),
    ('call sync; > sync;', 'SYNC')], ids=('unrequested', 'to the call', 'to an ECHO', 'SYNC'))
def test_what_waits_is_not_sent_to_a_board_that_begins_anew(session, before, reply):
    session.announces = True
    session.play(f'{before} call own; call lift; < {reply}')
    assert session.begun_anew == [session.now] and not session.announces
    session.play(('> SYNC; < SYNC; fence; ' if reply != 'SYNC' else '')
                 + 'send lift; own is not sent; lift is waiting')


def test_an_announced_stop_is_not_sent_to_a_board_that_begins_anew(session):
    session.announces = True
    session.play(f'{LIFTS} < INVALID:10; call ownstop; > SYNC; ownstop is not sent')


# -- the table -------------------------------------------------------------------------------------

def test_the_table_has_a_row_for_every_event_in_every_state():
    assert {kind: set(rows) for kind, rows in TRANSITIONS.items()} == {
        kind: set(Event) for kind in Kind}
