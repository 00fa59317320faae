"""The report of `ports`, as text and as JSON."""
import json
from typing import Iterable, List, Mapping, NamedTuple

from ...framing.layout import readable
from . import advice
from .devices import Device
from .holders import Holder
from .listening import Candidate, Received


class Found(NamedTuple):
    """One port, and what was received there."""

    device: Device
    holders: List[Holder]
    heard: Received


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
    """A paragraph for each port, notes, and the lines to put into a configuration.

    Args:
        config: the configuration that was given, or ''.
    """
    found = {port.heard.board: port for port in reversed(ports) if port.heard.board}
    notes = [*_notes(ports, found, boards, asked, config), *advice.of_computer()]
    if found:
        last = ['Put into a configuration (bridge.launch config:=FILE):']
        last += [f'{name}: {{port: {port.device.name}, baud: {port.heard.baud}}}'
                 for name, port in sorted(found.items())]
    else:
        last = ['No board was found.' + ' End the programs that have a port open, and run this '
                'again.' * any(port.holders for port in ports)]
    parts = [*(_port(port, boards, seconds) for port in ports),
             '\n'.join(f'note: {note}' for note in notes), '\n'.join(last)]
    return '\n\n'.join(filter(None, parts))


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


def _notes(ports: List[Found], found: Mapping[str, Found], boards: Mapping[str, Candidate],
           asked: bool, config: str) -> Iterable[str]:
    for name, first in found.items():
        if sum(port.heard.board == name for port in ports) > 1:
            yield f'{name} is on several ports; the first is taken: {first.device.name}'
    is_silent = any(port.heard.kind == 'nothing' and not port.heard.trouble for port in ports)
    questions = [name for name, each in boards.items()
                 if each.board.question and name not in found]
    if is_silent and questions and not asked:
        yield (f'the {" and the ".join(questions)} board is silent until it is asked: '
               'run this again with --ask')
    if not config and any(port.heard.kind == 'noise' for port in ports):
        yield ('a board that sends only custom messages is found with their configuration: run '
               'this again with --config FILE')
