"""The node, exactly: what happens to its process, and to others that it works with."""
import contextlib
import glob
import json
import signal
import threading
import time
import xmlrpc.client
from typing import Any, Dict, FrozenSet, Tuple

import rosgraph
import rospy
from std_msgs.msg import Empty

import by_definition as codec
from .boards import CUSTOM, POLLED, Reaction
from .exact_bus import Calls
from .exact_car import Drive, measurements
from .requirements import MAX_WAIT
from .rig import LATCHED, MOTION_TIMEOUT, QUIET_CAR, STOP_FIRST, Rig
from .robot import NODE

_END = 2.0               # s
_MASTER_RETURN = 10.0    # s
_NETWORK_AGE = 1.5       # s: arduino/network_silence and some delay
_NETWORK_RETURN = 3.0    # s
_ROW = b'hoist_%d: {type: %d, direction: to_board, ros_type: std_msgs/Empty, layout: <, fields: []}'
_NONSENSE = b'', b'\0\1\0\0{[', *(bytes((number,)) * 40 for number in range(256))
POLLING: Dict[str, Any] = {
    'bus/environment_period': 0.1,
    'bus/functions': json.dumps({**CUSTOM['bus/functions'], **POLLED})}


def second_bridge(rig: Rig) -> None:
    """Another bridge with the same name is started."""
    required = rig.require('node', 'a second bridge with the same name ends; the first continues')
    rig.settle()
    with rig.no_missed_heartbeat():
        second = rig.child('second', [*rig.bridge_command, f'__name:={NODE[1:]}'])
        required.wait(lambda: not second.alive, 'it ends')
    required.check(second.process.returncode == 3, f'exit status {second.process.returncode}')
    uri = rosgraph.Master('/campaign').lookupNode(NODE)
    required.check(xmlrpc.client.ServerProxy(uri).getPid('/campaign')[2] == rig.child_bridge.pid,
                   'the second one is registered at the master')
    Drive(rig).command()


def suspended_subscriber(rig: Rig) -> None:
    """SIGSTOP of a subscriber of all topics."""
    child = rig.user('subscriber', 'suspended_subscriber')
    child.hold()
    measurements(rig)
    rig.end(child)


def new_master(rig: Rig) -> None:
    """roscore ends, and another one starts at its address."""
    returns = rig.require('node', 'topics, services, parameters return within 10 s of a new master')
    continues = rig.require('node', 'without a master the ports stay open and commands arrive')
    rig.settle()
    before = _registered()
    connections = rig.car.connection, rig.bus.connection, rig.sensors.connection
    drive = Drive(rig)
    with rig.no_missed_heartbeat():
        rig.ask_master_to_end()
        rig.wait(lambda: not rig.master_runs, 'the master has ended')
        drive.command()
        rig.end_master()
        rig.start_master()
        began = time.monotonic()
        returns.wait(lambda: _registered() >= before, 'all is registered')
        returns.at_most(time.monotonic() - began, _MASTER_RETURN, 's', 'all is registered')
    rig.robot.register_again()
    drive.command()
    continues.check(rig.robot.call('lift', 0, 2).success, 'a call failed')
    continues.check((rig.car.connection, rig.bus.connection, rig.sensors.connection)
                    == connections, 'a port was opened again')


def _registered() -> FrozenSet[Tuple[str, str]]:
    """What the bridge has registered at the master; empty if there is no master."""
    master = rosgraph.Master('/campaign')
    try:
        names = [(str(kind), name) for kind, entries in enumerate(master.getSystemState())
                 for name, nodes in entries if NODE in nodes]
        return frozenset([*names, *(('parameter', key) for key in master.getParam(NODE))])
    except (OSError, rosgraph.MasterException):
        return frozenset()


def resets(rig: Rig) -> None:
    """Each board is reset: its current frame stays incomplete, it is silent, then starts again."""
    required = rig.require('bus', 'after a reset of the board SYNC brings it in step again')
    calls = Calls(rig)
    rig.settle()
    with rig.no_missed_heartbeat():
        for board, incomplete in (rig.sensors, b'\x02\x0c\x10\x01'), (rig.car, b'\x05\x07\x01'):
            for _ in range(5):
                board.measure()
            board.line.write(incomplete)
        key, future = calls.start_unanswered()
        rig.bus.in_step, rig.bus.react = False, None
        calls.check(key, future.result(MAX_WAIT), 'reset', 'not known', MOTION_TIMEOUT)
        rig.sleep(1.0)
        rig.sensors.seq = 0
        for _ in range(5):
            rig.car.measure()
            rig.sensors.measure()
        calls.call('lift', 'after a reset', 'done')
        required.check(rig.bus.in_step, 'no SYNC was received')
    rig.compare(rig.car, rig.sensors)


def killed(rig: Rig) -> None:
    """SIGKILL while the car drives; then another bridge, an absent port, an old latched speed."""
    first, latched = rig.require(*STOP_FIRST), rig.require(*LATCHED)
    absent = rig.require('ports', 'a port that is absent at the start is opened when it appears')
    rig.settle()
    drive = Drive(rig)
    number = drive.command().number
    child = rig.user('latching', 'early', 301, 302)
    rig.end(rig.child_bridge, signal.SIGKILL)
    rig.car_line.drain()
    rig.car.start_connection()
    rig.bus.start_connection()
    rig.mcu_line.unplug()
    since = len(rig.car.packets)
    rig.start({**POLLING, **QUIET_CAR})
    packet = rig.car.first[rig.car.connection]
    first.check(packet.is_stop, f'the first packet was {packet}')
    child.order('next')
    latched.wait(lambda: rig.car.packet(codec.SPEED, 302), 'the new speed arrives')
    latched.check(not rig.car.packet(codec.SPEED, 301, since), 'the latched speed 301 arrived')
    drive.check_not_sent([number], 'speed', 'from before SIGKILL', since)
    rig.end(child)
    rig.mcu_line.plug()
    rig.wait_for_data('mcu/cliff', rig.sensors.cliff, absent)


class _WaitForProcessor:
    """How long that thread of a process that waited longest was ready to run, but got no processor
    time. The kernel counts it. Other programs of this machine cause it, not the process."""

    def __init__(self, pid: int) -> None:
        self._pid, self._seconds = pid, 0.0
        self._before = self._read()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='wait for processor', daemon=True)
        self._thread.start()

    def end(self) -> float:
        """Return the s since this was created."""
        self._stopping.set()
        self._thread.join()
        return self._seconds

    def _run(self) -> None:
        while not self._stopping.wait(0.02):
            self._seconds = max([self._seconds, *(waited - self._before.get(thread, 0.0)
                                                  for thread, waited in self._read().items())])

    def _read(self) -> Dict[str, float]:
        waited = {}
        for path in glob.glob(f'/proc/{self._pid}/task/*/schedstat'):
            with contextlib.suppress(OSError, IndexError):      # the thread has ended
                with open(path) as file:
                    waited[path] = int(file.read().split()[1]) / 1e9
        return waited


class End:
    """A signal ends the bridge while the car drives and a call waits for its reply.

    Args:
        number: the signal.
        hang: instead of the call, the ports of bus and mcu take no bytes.
    """

    def __init__(self, number: int, hang: bool) -> None:
        self.__name__ = f'end by {signal.Signals(number).name}{", ports hang" if hang else ""}'
        self._number = number
        self._hang = hang

    def __call__(self, rig: Rig) -> None:
        with rig.measuring():
            self._end(rig)

    def _end(self, rig: Rig) -> None:
        required = rig.require('node', 'it ends within 2 s, whatever hangs; last packet SPEED 0')
        rig.settle()
        drive, lines = Drive(rig), (rig.bus_line, rig.mcu_line)
        if self._hang:
            for line in lines:
                line.frozen = True
                line.fill()
                line.set_flow(False)
        else:
            rig.bus.react = lambda request: Reaction([], True)
            rig.robot.start_call('lift', 1, 1)
            rig.wait(lambda: rig.bus.executed, 'the request arrives')
        drive.command()
        waited = _WaitForProcessor(rig.child_bridge.process.pid)
        took = rig.end(rig.child_bridge, self._number)
        required.at_most(took - waited.end(), _END, 's', self.__name__)
        rig.car_line.drain()
        last, status = rig.car.packets[-1], rig.child_bridge.process.returncode
        heartbeats = [*rig.car.ended, rig.car.heartbeats][last.connection]
        required.check(last.is_stop and last.heartbeats == heartbeats,
                       f'{self.__name__}: {heartbeats - last.heartbeats} heartbeats after {last}')
        required.check(status == 0, f'{self.__name__}: its exit status is {status}')
        for line in lines if self._hang else ():
            line.set_flow(True)
            line.frozen = False
            line.drain()


def network(rig: Rig) -> None:
    """The car's network freezes, or loses the connection."""
    fresh = rig.require('network', 'no SPEED older than 1.5 s reaches a board behind socket://')
    returns = rig.require('network', "heartbeats within 3 s of the network's return")
    first, drive, car = rig.require(*STOP_FIRST), Drive(rig), rig.car
    for event in (rig.car_line.freeze, rig.car_line.lose_connection, rig.car_line.freeze):
        with rig.measuring():
            drive.command_until_accepted()
            since, connection = len(car.packets), car.connection
            event()
            commanded: Dict[int, float] = {}
            for _ in range(50):
                now = time.monotonic()
                commanded[drive.publish(1, 'speed')[0]] = now
            rig.car_line.thaw()
            returned = time.monotonic()
            returns.wait(lambda: car.connection > connection and car.heartbeats > 5, 'heartbeats')
            returns.at_most(time.monotonic() - returned, _NETWORK_RETURN, 's', event.__name__)
            drive.command_until_accepted()
        for packet in car.packets[since:]:
            if packet.type == codec.SPEED and packet.number in commanded:
                fresh.at_most(packet.t - commanded[packet.number], _NETWORK_AGE, 's',
                              f'{event.__name__}: SPEED {packet.number}')
        for packet in [car.first[number] for number in car.first if number > connection]:
            first.check(packet.is_stop, f'the first packet was {packet}')


def announcements(rig: Rig) -> None:
    """The car announces half a text and nonsense, then one row; then it is flashed."""
    required = rig.require('announcements', 'the rows of the last whole text are in use, no others')
    again = rig.require('announcements', 'no command after a reconnect, until announced again')
    for type_ in 70, 71, 72:
        rig.settle()
        text, name = _ROW % (type_, type_), f'hoist_{type_}'
        with rig.no_missed_heartbeat():
            for chunk in (*codec.announcement(b'half' + text, 50)[:-1], *_NONSENSE,
                          *codec.announcement(text, 50)):
                rig.car.write(codec.arduino_packet(codec.ANNOUNCEMENT, chunk))
            required.wait(lambda: [*rospy.get_param(NODE + '/arduino/announced', {})] == [name],
                          f'{name} is in use')
        command = rospy.Publisher(f'{NODE}/{name}', Empty, queue_size=1)
        rig.wait(command.get_num_connections, 'the bridge subscribes')
        rig.car_line.unplug()
        rig.car_line.plug()
        rig.wait(lambda: rig.car.heartbeats, 'heartbeats')
        command.publish()
        Drive(rig).command()
        again.check(type_ not in [each.type for each in rig.car.packets], f'{name} arrived')


SCENARIOS = second_bridge, suspended_subscriber, new_master, resets, announcements
