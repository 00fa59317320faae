"""However the bridge is ended: SPEED 0 is its last word, and it is gone within 2 s.

A campaign's last part, on sound lines: SIGINT, SIGTERM, roslaunch's stop; with a lift call that
waits, with ports that hang; and SIGKILL, after which roslaunch has data flowing again.
"""
import os
import pty
import signal
import termios
import time
import tty
import xmlrpc.client
from typing import Any, Dict, List, Optional, Tuple

import psutil
import rosgraph

from serial_communication.tools.watch.topics import NODE
from .expected import LINKS
from .packets import SPEED, packets_of
from .records import read_lines, read_messages
from .stage import CampaignStage, say
from .table import Row

ENDING = 2.0             # s that the node may take to end
RETURN = 5.0             # s from SIGKILL to data
_FLUSH = 0.7             # s until a journal holds what happened
_SPEED_0 = (SPEED, b'\0\0')


class HungPort:
    """A port that takes nothing: its other end does not read, and its buffers are full.

    Args:
        held: by flow control instead, which also survives its being flushed.
    """

    def __init__(self, held: bool) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.name = os.ttyname(self._slave)
        os.set_blocking(self._slave, False)
        try:
            while True:
                os.write(self._slave, bytes(4096))
        except BlockingIOError:
            pass
        if held:
            termios.tcflow(self._slave, termios.TCOOFF)

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


class Shutdown:
    """Runs the cases one after the other; `rows` is what came out."""

    def __init__(self, stage: CampaignStage, seed: int) -> None:
        self._stage = stage
        self._results: Dict[str, List[Tuple[str, float, List[str]]]] = {}
        self._ports: Dict[str, str] = {}
        for link in LINKS:
            options = ('--lift-speed', '20') if link == 'bus' else ()
            cable = stage.cable('last_' + link)
            self._ports[link] = cable.near
            stage.board(link, cable.far, seed, *options, name=f'last_{link}_board',
                        journal=stage.path(f'last_{link}.journal'))
        self._driver = stage.user('driver', 'last_calls.jsonl', seed, orders=True)
        self._recorder = stage.user('recorder', 'last_messages.bin', seed)

    def run(self, with_roslaunch: bool = True) -> List[Row]:
        """All cases."""
        self._case('SIGINT', signal.SIGINT)
        self._case('SIGTERM', signal.SIGTERM)
        self._case('SIGINT, a lift call waits', signal.SIGINT, waiting=True)
        self._case('SIGTERM, a lift call waits', signal.SIGTERM, waiting=True)
        self._case('SIGINT, the other ports are held', signal.SIGINT, hang=('bus', 'mcu'))
        self._case('SIGINT, every port is full', signal.SIGINT, hang=LINKS, held=False)
        self._case('SIGTERM, every port is held', signal.SIGTERM, hang=LINKS)
        back: Optional[float] = None
        if with_roslaunch:
            back = self._under_roslaunch()
        return self._rows(back, with_roslaunch)

    # -- cases ----------------------------------------------------------------------------

    def _case(self, name: str, number: int, waiting: bool = False, hang: Tuple[str, ...] = (),
              held: bool = True) -> None:
        say('shutdown: ' + name)
        hung = {link: HungPort(held) for link in hang}
        ports = dict(self._ports, **{link: port.name for link, port in hung.items()})
        bridge = self._stage.bridge(ports, {'bus/motion_timeout': 60.0})
        drives = 'arduino' not in hung
        try:
            if drives:
                self._wait_for_driving()
            else:
                self._stage.wait(lambda: _pid_of_node() == bridge.pid, 'the bridge is up')
                time.sleep(1.0)
            if waiting:
                self._driver.order('lift')
                time.sleep(1.0)
            began = time.monotonic()
            took = self._stage.end(bridge, number, 8.0)
            self._note(name, began, took, bridge.process.returncode, drives)
        finally:
            for port in hung.values():
                port.close()

    def _under_roslaunch(self) -> float:
        """Returns the seconds from SIGKILL to data."""
        say('shutdown: SIGKILL under roslaunch, then its stop')
        launch = self._stage.child('roslaunch', [
            'roslaunch', '--wait', 'serial_communication', 'bridge.launch'] + [
                f'{link}_port:={port}' for link, port in self._ports.items()])
        self._wait_for_driving()
        killed = time.monotonic()
        os.kill(_pid_of_node(), signal.SIGKILL)
        back = None
        while back is None and time.monotonic() < killed + 2 * RETURN:
            time.sleep(0.2)
            back = self._data_after(killed + 0.3)
        self._wait_for_driving()
        pid = _pid_of_node()
        self._driver.order('lift')
        time.sleep(1.0)
        began = time.monotonic()
        launch.send(signal.SIGINT)
        while _lives(pid) and time.monotonic() < began + 8:
            time.sleep(0.01)
        self._note("roslaunch's stop, a lift call waits", began, time.monotonic() - began, 0, True)
        self._stage.end(launch, signal.SIGINT, 20.0)
        return back - killed if back else float('inf')

    def _note(self, name: str, began: float, took: float, status: int, speaks: bool) -> None:
        time.sleep(_FLUSH)
        troubles = []
        if took > ENDING:
            troubles.append(f'it took {took:.2f} s to end')
        if status < 0:
            troubles.append(f'signal {-status} killed it')
        if speaks:
            last = [packet for packet in self._packets() if packet.t >= began - 1.0]
            if not last or (last[-1].type, last[-1].data) != _SPEED_0:
                troubles.append(f"the last packet is {last[-1:] or 'none'}")
        self._results.setdefault('speaks' if speaks else 'hangs', []).append(
            (name, took, troubles))

    # -- looking ---------------------------------------------------------------------------

    def _packets(self) -> List[Any]:
        return packets_of(read_lines(self._stage.path('last_arduino.journal')))[0]

    def _wait_for_driving(self) -> None:
        """Until the car drives by what came after now."""
        began = time.monotonic()
        self._stage.wait(lambda: any(
            packet.type == SPEED and packet.t > began and packet.data != b'\0\0'
            for packet in self._packets()), 'the car drives')

    def _data_after(self, t: float) -> Optional[float]:
        for message in read_messages(self._stage.path('last_messages.bin'))[1]:
            if message.t > t and message.topic == NODE + '/imu':
                return message.t
        return None

    # -- rows ------------------------------------------------------------------------------

    def _rows(self, back: Optional[float], with_roslaunch: bool) -> List[Row]:
        rows = []
        for key, says in (
                ('speaks', 'SIGINT, SIGTERM, roslaunch\'s stop: SPEED 0 last, ended within 2 s'),
                ('hangs', 'the same while every port hangs: ended within 2 s')):
            cases = self._results.get(key, [])
            rows.append(Row(
                'shutdown', says, len(cases),
                [(0.0, f'{name}: {trouble}') for name, _took, troubles in cases
                 for trouble in troubles],
                f'{max([took for _name, took, _troubles in cases] or [0.0]):.2f} s'))
        if with_roslaunch:
            rows.append(Row(
                'shutdown', 'after SIGKILL, respawn has data flowing again within 5 s', 1,
                [] if back <= RETURN else [(0.0, f'data after {back:.2f} s')], f'{back:.2f} s'))
        return rows


def _pid_of_node() -> int:
    """Of the bridge that the master knows; 0 if there is none."""
    try:
        uri = rosgraph.Master('/soak').lookupNode(NODE)
        return xmlrpc.client.ServerProxy(uri).getPid('/soak')[2]
    except (OSError, rosgraph.MasterException, xmlrpc.client.Error):
        return 0


def _lives(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
