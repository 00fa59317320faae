"""The report of `ports`, as text and as JSON."""
import json
import os
from typing import Dict, Iterable, List, Mapping, NamedTuple

from ...boards import BOARDS
from ...framing.layout import readable
from . import advice
from .configuration import Connection
from .devices import Device
from .holders import Holder
from .listening import Candidate, Received


class Found(NamedTuple):
    """One port, and what was received there."""

    device: Device
    holders: List[Holder]
    heard: Received


def connections(ports: Iterable[Found]) -> Dict[str, Connection]:
    """The port of each board that was found; of two with the same board the first."""
    found: Dict[str, Connection] = {}
    for port in ports:
        if port.heard.board and port.heard.baud:
            found.setdefault(port.heard.board, Connection(port.device.name, port.heard.baud))
    return found


def as_json(ports: Iterable[Found]) -> str:
    """A list with an object for each port."""
    return json.dumps([{
        'port': port.device.path,
        'board': port.heard.board or None,
        'heard': port.heard.kind,
        'baud': port.heard.baud,
        'held_by': ', '.join(map(str, port.holders)) or None,
        'name': port.device.name,
        'by_id': port.device.by_id or None,
        'by_path': port.device.by_path or None,
        'adapter': port.device.adapter or None,
        'bytes': port.heard.size,
        'trouble': port.heard.trouble or None,
        'advice': advice.of_port(port.device.path),
    } for port in ports], indent=2)


def as_text(ports: List[Found], boards: Mapping[str, Candidate], seconds: float,
            asked: bool, config: str) -> str:
    """A paragraph for each port, and lines to paste; with the configuration if one was given."""
    parts = [_port(port, boards, seconds) for port in ports]
    parts.append('\n'.join(_to_paste(ports, boards, asked, config)))
    remedies = advice.of_computer()
    if remedies:
        parts.append('\n'.join(f'note: {remedy}' for remedy in remedies))
    return '\n\n'.join(parts)


def _port(port: Found, boards: Mapping[str, Candidate], seconds: float) -> str:
    device, heard = port.device, port.heard
    lines = [f'{device.path}  {_meaning(heard, boards)}']
    by_id = device.by_id if device.serial or not device.by_id else \
        f'{device.by_id} (the same for every adapter of this kind: it has no serial number)'
    adapter = f'{device.adapter} ({device.usb_id})' if device.usb_id else device.adapter
    lines += [f'    {what:<9}{words}' for what, words in (
        ('by-id', by_id), ('by-path', device.by_path), ('adapter', adapter),
        ('open in', ', '.join(map(str, port.holders))), ('received', _received(heard, seconds)))
        if words]
    return '\n'.join(lines + [f'    {remedy}' for remedy in advice.of_port(device.path)])


def _meaning(heard: Received, boards: Mapping[str, Candidate]) -> str:
    if heard.board:
        board = boards[heard.board].board
        other = f', at {heard.baud} baud' if heard.baud != board.baud else ''
        title = f' ({board.title})' if board.title else ''
        return board.name + title + other
    if heard.trouble:
        return f'not listened to: {heard.trouble}'
    return 'bytes of no known board, at no usual baud rate' if heard.size else 'silent'


def _received(heard: Received, seconds: float) -> str:
    if not heard.size or heard.board:
        return ''
    words = readable(heard.sample.decode('utf-8', 'replace').strip()) \
        if sum(32 <= byte < 127 for byte in heard.sample) * 4 > 3 * len(heard.sample) else ''
    return f'{heard.size} bytes in {seconds:g} s: {heard.sample.hex()} …' + (
        f' (text: {words!r})' if words else '')


def _to_paste(ports: List[Found], boards: Mapping[str, Candidate], asked: bool,
              config: str) -> List[str]:
    found = connections(ports)
    lines = [f'note: {name} is on several ports; the first is taken: {connection.port}'
             for name, connection in found.items()
             if sum(port.heard.board == name for port in ports) > 1]
    is_silent = any(port.heard.kind == 'nothing' and not port.heard.trouble for port in ports)
    questions = [name for name, each in boards.items()
                 if each.board.question and name not in found]
    if is_silent and questions and not asked:
        lines.append(f'note: the {" and the ".join(questions)} board is silent until it is asked: '
                     'run this again with --ask')
    if not config and any(port.heard.kind == 'noise' for port in ports):
        lines.append('note: a board that sends only custom messages is found with their '
                     'configuration: run this again with --config FILE')
    if not found and any(port.holders for port in ports):
        return lines + ['No board was found. End the programs that have a port open, and run this '
                        'again.']
    if not found:
        return lines + ['No board was found.']
    if all(name in BOARDS and connection.baud == boards[name].baud
           for name, connection in found.items()):
        arguments = [f'{name}_port:={found[name].port}' for name in BOARDS if name in found]
        arguments += [f'config:={os.path.abspath(config)}'] * bool(config)
        return lines + ['roslaunch serial_communication bridge.launch ' + ' '.join(arguments)]
    return lines + ['In the configuration:'] + [
        f'{name}: {{port: {connection.port}, baud: {connection.baud}}}'
        for name, connection in found.items()]
