"""The node, exactly: what happens to it as a process, and beside it."""
import json
import signal
import time
import xmlrpc.client
from typing import Any, Dict, FrozenSet, Tuple

import rosgraph

import by_definition as codec
from .boards import CUSTOM, POLLED, Answer
from .exact_bus import Calls
from .exact_car import Drive, measurements
from .field import FIRST, LATCHED, MOTION_TIMEOUT, Field
from .robot import NODE
from .rows import PATIENCE

ENDING = 2.0             # s
MASTER_RETURN = 10.0     # s
NETWORK_AGE = 1.5        # s: about arduino/network_silence
NETWORK_RETURN = 3.0     # s
POLLING: Dict[str, Any] = {
    'bus/environment_period': 0.1,
    'bus/functions': json.dumps({**CUSTOM['bus/functions'], **POLLED})}


def second_bridge(field: Field) -> None:
    """One of the same name is started: it ends, and the first one goes on."""
    row = field.row('node', 'a second bridge of the same name ends and takes nothing away')
    field.calm()
    with field.heartbeats():
        second = field.child('second', [*field.bridge_command, f'__name:={NODE[1:]}'])
        row.wait(lambda: not second.alive, 'it ends')
    row.check(second.process.returncode == 3, f'its status is {second.process.returncode}')
    uri = rosgraph.Master('/campaign').lookupNode(NODE)
    row.check(xmlrpc.client.ServerProxy(uri).getPid('/campaign')[2] == field.child_bridge.pid,
              'the master knows the second one')
    Drive(field).command()


def stopped_subscriber(field: Field) -> None:
    """SIGSTOP of a subscriber of everything."""
    child = field.user('listener', 'stopped_listener')
    child.hold()
    measurements(field)
    field.end(child)


def new_master(field: Field) -> None:
    """roscore ends, and another one begins at its address."""
    back = field.row('node', 'a new master: topics, services, parameters are back within 10 s')
    same = field.row('node', 'meanwhile no port is opened anew, and commands go on')
    field.calm()
    before = _registered()
    connections = field.car.connection, field.bus.connection, field.sensors.connection
    drive = Drive(field)
    with field.heartbeats():
        field.ask_master_to_end()
        field.wait(lambda: not field.master_runs, 'the master has ended')
        drive.command()
        field.end_master()
        field.start_master()
        began = time.monotonic()
        back.wait(lambda: _registered() >= before, 'all is registered')
        back.at_most(time.monotonic() - began, MASTER_RETURN, 's', 'all is registered')
    field.robot.register_again()
    drive.command()
    same.check(field.robot.call('lift', 0, 2).success, 'a call was not served')
    same.check((field.car.connection, field.bus.connection, field.sensors.connection)
               == connections, 'a port was opened anew')


def _registered() -> FrozenSet[Tuple[str, str]]:
    """What the master knows of the bridge; nothing where none answers."""
    master = rosgraph.Master('/campaign')
    try:
        names = [(str(kind), name) for kind, entries in enumerate(master.getSystemState())
                 for name, nodes in entries if NODE in nodes]
        return frozenset([*names, *(('parameter', key) for key in master.getParam(NODE))])
    except (OSError, rosgraph.MasterException):
        return frozenset()


def resets(field: Field) -> None:
    """Each board resets: what it was about to send ends, it is silent, and begins anew."""
    step = field.row('bus', 'a board that resets is brought in step again, with SYNC')
    calls = Calls(field)
    field.calm()
    with field.heartbeats():
        for board, begun in (field.sensors, b'\x02\x0c\x10\x01'), (field.car, b'\x05\x07\x01'):
            for _ in range(5):
                board.measure()
            board.line.write(begun)
        key, asked = calls.begin()
        field.bus.in_step, field.bus.rule = False, None
        calls.judge(key, asked.result(PATIENCE), 'the board resets', 'timeout', MOTION_TIMEOUT)
        field.let_pass(1.0)
        field.sensors.seq = 0
        for _ in range(5):
            field.car.measure()
            field.sensors.measure()
        calls.make('lift', 'after a reset', 'success')
        step.check(field.bus.in_step, 'no SYNC has come')
    field.compare(field.car, field.sensors)


def killed(field: Field) -> None:
    """SIGKILL while the car drives; then another bridge, a port absent, a publisher latching."""
    first, old = field.row(*FIRST), field.row(*LATCHED)
    absent = field.row('ports', 'a port that is absent at the start is waited for')
    field.calm()
    drive = Drive(field)
    number = drive.command().number
    child = field.user('latch', 'early', 301, 302)
    field.end(field.child_bridge, signal.SIGKILL)
    field.car_line.drain()
    field.car.open_anew()
    field.bus.open_anew()
    field.mcu_line.unplug()
    since = len(field.car.packets)
    field.start(POLLING)
    one = field.car.first[field.car.connection]
    first.check(one.stops, f'{one} was the first')
    old.wait(lambda: 'connected' in child.tail()[-12:], 'the bridge connects')
    child.order('next')
    old.wait(lambda: field.car.packet(codec.SPEED, 302), 'the next one arrives')
    old.check(not field.car.packet(codec.SPEED, 301, since), 'latched before the start: arrived')
    drive.none_of([number], 'speed', 'commanded before SIGKILL', since)
    field.end(child)
    field.mcu_line.plug()
    field.flows('mcu/cliff', field.sensors.cliff, absent)


class Ends:
    """The bridge is told to end while the car drives and a call waits; or while the ports of bus
    and mcu take nothing.

    Args:
        number: the signal.
    """

    def __init__(self, number: int, hang: bool) -> None:
        self.__name__ = f'ends by {signal.Signals(number).name}{", ports hang" if hang else ""}'
        self._number = number
        self._hang = hang

    def __call__(self, field: Field) -> None:
        with field.talking():
            self._end(field)

    def _end(self, field: Field) -> None:
        row = field.row('node', 'it ends within 2 s, whatever hangs: SPEED 0, then silence')
        field.calm()
        drive, lines = Drive(field), (field.bus_line, field.mcu_line)
        if self._hang:
            for line in lines:
                line.frozen = True
                line.fill()
                line.flow(False)
        else:
            field.bus.rule = lambda request: Answer([], True)
            field.robot.calling('lift', 1, 1)
            field.wait(lambda: field.bus.executed, 'the call arrives')
        drive.command()
        row.at_most(field.end(field.child_bridge, self._number), ENDING, 's', self.__name__)
        field.car_line.drain()
        last, status = field.car.packets[-1], field.child_bridge.process.returncode
        beats = [*field.car.ended, field.car.beat][last.connection]
        row.check(last.stops and last.beat == beats,
                  f'{self.__name__}: {beats - last.beat} heartbeats after {last}')
        row.check(status == 0, f'{self.__name__}: its status is {status}')
        for line in lines if self._hang else ():
            line.flow(True)
            line.frozen = False
            line.drain()


def network(field: Field) -> None:
    """The car is behind a network, which freezes, or forgets the connection."""
    fresh = field.row('network', 'no SPEED of over 1.5 s ago reaches a board behind socket://')
    back = field.row('network', 'heartbeats within 3 s of its return')
    first, drive, car = field.row(*FIRST), Drive(field), field.car
    for event in (field.car_line.freeze, field.car_line.vanish, field.car_line.freeze):
        with field.talking():
            drive.again()
            since, connection = len(car.packets), car.connection
            event()
            commanded: Dict[int, float] = {}
            for _ in range(50):
                now = time.monotonic()
                commanded[drive.in_vain(1, 'speed')[0]] = now
            field.car_line.thaw()
            returned = time.monotonic()
            back.wait(lambda: car.connection > connection and car.beat > 5, 'heartbeats')
            back.at_most(time.monotonic() - returned, NETWORK_RETURN, 's', event.__name__)
            drive.again()
        for packet in car.packets[since:]:
            if packet.type == codec.SPEED and packet.number in commanded:
                fresh.at_most(packet.t - commanded[packet.number], NETWORK_AGE, 's',
                              f'{event.__name__}: SPEED {packet.number}')
        for number in range(connection + 1, car.connection + 1):
            if number in car.first:
                first.check(car.first[number].stops, f'{car.first[number]} was the first')


SCENARIOS = second_bridge, stopped_subscriber, new_master, resets
