"""Broken bridges: each breaks one promise, by one method, and the judge has to find it.

A mutant is a broken promise, not a place: a rebuild of the bridge moves its place, never its fault.
`SEEDS` has a seed that finds each. Run this file to search them anew.
"""
import json
import time
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, NamedTuple

import judge        # first: it makes the package findable


class Mutant(NamedTuple):
    """A promise that is broken: what `patch` returns takes the place of a method."""

    promise: str
    owner: str      # module and class of the package
    method: str
    patch: Callable[[Callable], Any]     # gets the method


def _nothing(_method: Callable) -> Callable:
    return lambda *_, **__: None


def _returns(value: Any) -> Callable[[Callable], Callable]:
    return lambda _method: lambda *_, **__: value


def _without(attribute: str, method: Callable, session: Any, *arguments: Any) -> Any:
    value = getattr(session, attribute)
    setattr(session, attribute, None)
    try:
        return method(session, *arguments)
    finally:
        setattr(session, attribute, value)


MUTANTS: Dict[str, Mutant] = {
    'no fence before a call': Mutant(
        'a fence precedes every call', 'boards.bus.channel.Channel', 'is_fenced', _returns(True)),
    'a move is sent again after a timeout': Mutant(
        'a move is never sent again after a timeout', 'boards.bus.call.Queue', 'again',
        lambda _method: lambda self, call, *_, **__: self.waiting.insert(0, call)),
    'a stop waits for its turn': Mutant(
        'a stop is sent at once', 'boards.bus.call.Queue', 'urgent', _returns([])),
    'an old call is sent after a stall': Mutant(
        'a call is as old as a command', 'link.freshness.Freshness', 'is_fresh', _returns(True)),
    'a call outlives its port': Mutant(
        'an outstanding call is not known when the port closes', 'boards.bus.session.MasterSession',
        'end', _nothing),
    'no SYNC after an opening': Mutant(
        'SYNC comes first', 'boards.bus.channel.Channel', 'begin',
        lambda _method: lambda self: setattr(
            self, 'state', type(self.state).OUT_OF_STEP)),
    'moves while stopped': Mutant(
        '~stop holds on the bus', 'boards.bus.session.MasterSession',
        '_outcome_of_waiting', lambda method: lambda self, call, now: _without(
            'is_stopped', method, self, call, now)),
    'the timeout of the speed is doubled': Mutant(
        'SPEED 0 after 0.5 s without a command', 'boards.arduino.motion.Motion', '__init__',
        lambda method: lambda self, zero, timeout: method(self, zero, 2 * timeout)),
    'a stop is not repeated': Mutant(
        'a stop is repeated for 1 s', 'boards.arduino.motion.Motion', 'due',
        lambda method: lambda self, *arguments: self.moves and method(self, *arguments)),
    'SPEED 0 does not come first': Mutant(
        'SPEED 0 first', 'boards.arduino.motion.Motion', 'forget', _nothing),
    'a stall is not noticed by the car': Mutant(
        'commands of a stall are refused', 'link.freshness.Freshness', 'awake',
        lambda _method: lambda self, loop, now, stamp=None: self._awake.update(
            {loop: now}) or ''),
    'a backlog is kept': Mutant(
        'what stands in a port is dropped', 'transport.port.Port', 'renew', _returns(0)),
    'heartbeats wait for the link': Mutant(
        'heartbeats are in time', 'link.writer.Writer', 'beat',
        lambda method: lambda self: max(
            method(self), self._now() + 0.04)),
    'commands while it calibrates': Mutant(
        'a calibrating board is left alone', 'boards.arduino.session.CarSession', 'submit',
        lambda method: lambda self, message, now: _without(
            'calibration', method, self, message, now)),
    'the car moves while stopped': Mutant(
        '~stop holds', 'boards.arduino.session.CarSession', '_moves', _returns(False)),
    'stale bytes are published': Mutant(
        'no stale value', 'link.link.Link', '_awake', lambda _method:
            lambda self, now: self.writer.fresh.awake('link', now) and ''),
    'an announcement is kept over an opening': Mutant(
        'announced rows wait', 'framing.announcement.Assembly', 'reset', _nothing),
    'values of an old announcement': Mutant(
        'values are of this board', 'link.announcement.BoardAnnouncement', 'holds_back',
        _returns(False)),
    'a setting is confirmed by an older report': Mutant(
        'a confirmed setting is in use', 'link.settings.BoardSettings', 'send', lambda method:
            lambda self, now, is_current: [
                setattr(state, 'confirmed', state.value is not None)
                for state in self._states.values()] and method(self, now, is_current)),
    'a lent port is opened': Mutant(
        'a lent port is left alone', 'link.lending.Lending', 'runs',
        lambda _method: property(lambda self: False)),
    'a loan without SPEED 0': Mutant(
        'SPEED 0 is the last packet before a loan', 'link.lending.Lending', '_let_go', _nothing),
    'a stamp of the moment it is published': Mutant(
        'a stamp is of the read', 'link.stamps.Stamps', 'of', lambda _method:
            lambda self, frame, read: read.stamp + 0.001),
    'a silent board is not reported': Mutant(
        'a silent board is reported', 'boards.mcu.session.SensorSession', 'idle', lambda _method:
            lambda self, now: now + 0.1),
    'frames are lost': Mutant(
        'every valid frame is published', 'link.receiver.Receiver', '_deliver', lambda method:
            lambda self, frame, now: None if frame.raw[2:3] == b'\x05' else method(
                self, frame, now)),
    'frames are doubled': Mutant(
        'a value is published once', 'link.receiver.Receiver', '_deliver', lambda method:
            lambda self, frame, now: [method(self, frame, now) for _ in range(
                1 + (frame.raw[2:3] == b'\x05'))]),
    'a call is given up behind another one': Mutant(
        'a call is not given up while it may be served', 'boards.bus.session.MasterSession',
        '_timed_out',
        lambda method: lambda self, exchange, now: (
            self.queue.end(lambda call: call.without_reply('busy')), method(
                self, exchange, now))),
    'a call that was refused is not sent again': Mutant(
        'a refused call is repeated', 'boards.bus.call.Queue', 'again',
        lambda method: lambda self, call, now, told, refused=None: (
            refused and setattr(call, 'tries', 0), method(self, call, now, told, refused))),
    'polls pile up': Mutant(
        'polls do not pile up', 'boards.bus.polls.Polls', 'tick', lambda method:
            lambda self, now, is_announced: ([setattr(each, 'latest', None) for each in
                                              self._polls], method(self, now, is_announced))[1]),
    'a silence of 1 s ends a calibration': Mutant(
        'a calibration ends after a silence of 2 s', 'boards.arduino.calibration.Calibration',
        'imu_data', lambda method: lambda self, now: (
            setattr(self, '_last_data', self._last_data - 1.0), method(self, now))[1]),
    'damage is counted twice': Mutant(
        'what is damaged is counted once', 'link.receiver.Receiver', '_deliver',
        lambda method: lambda self, frame, now: (
            method(self, frame, now), self._session.errors.update(
                framing=frame.cause == 'framing'))),
    'a silent pty is trusted': Mutant(
        'a silent pty takes no command', 'link.link.Link', '_check_port', _returns(None)),
    'changed settings leave no doubt': Mutant(
        'SPEED 0 after settings were restored', 'transport.port.Port', 'changed_settings',
        lambda method: lambda self: method(self) and str(self.renew())[:0]),
    'the port is not opened again': Mutant(
        'a port that is back is opened', 'link.reopening.Reopening', 'lost', lambda method:
            lambda self, why, now: (method(self, why, now), setattr(self, 'at', now + 30.0))),
}
_FILE = Path(__file__).with_name('mutants.json')
SEEDS: Dict[str, int] = json.loads(_FILE.read_text()) if _FILE.exists() else {}
_MOST = 200     # seeds within which each has to be found


@contextmanager
def broken_by(name: str) -> Iterator[None]:
    """A context in which the bridge is broken by this mutant."""
    mutant = MUTANTS[name]
    module, owner_name = mutant.owner.rsplit('.', 1)
    owner = getattr(import_module(f'serial_communication.{module}'), owner_name)
    method = vars(owner)[mutant.method]
    setattr(owner, mutant.method, mutant.patch(method))
    try:
        yield
    finally:
        setattr(owner, mutant.method, method)


def _search() -> None:
    found: Dict[str, int] = {}
    for name in MUTANTS:
        began = time.monotonic()
        with broken_by(name):
            for seed in range(_MOST):
                broken = judge.run(seed).broken
                if broken:
                    found[name] = seed
                    print(f'{name:46} {seed:4} {time.monotonic() - began:6.1f} s  {min(broken)}',
                          flush=True)
                    break
            else:
                print(f'{name:46} not found in {_MOST} seeds', flush=True)
    _FILE.write_text(json.dumps(found, indent=1) + '\n')


if __name__ == '__main__':
    _search()
