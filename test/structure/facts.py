"""Compares the places that have to know of a board, of a packet, of a function of the bus, or of a
thread.

Each line that it prints begins with the place where something is missing. doc/developing.md lists
the places. It needs no ROS. For a copy of the package: PYTHONPATH=COPY python3 facts.py COPY
"""
import ast
import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any, Dict, Iterator, List, Set
from xml.etree import ElementTree

import yaml

from serial_communication.boards import BOARDS, description
from serial_communication.boards.bus import messages as bus
from serial_communication.boards.bus import wire as bus_wire
from serial_communication.boards.description import Description
from serial_communication.framing.custom_messages import RESERVED
from serial_communication.framing.layout import LayoutMessage
from serial_communication.simulation.line import SimulatedLine

FILES = ('wire.py', 'link.py', 'ros.py', 'simulator.py')    # besides __init__.py
LINKS = {     # with packets of a type: the header of the firmware, and the start of its constants
    'arduino': ('arduino_packets.h', r'enum class MessageType', r'\w+'),
    'mcu': ('stx_etx.h', r'', r'kType\w+')}
_PAGE = 'doc/protocols.md'
_OWN = 'serial_communication/'      # the ROS types of this package


def problems(root: Path) -> List[str]:
    """Return a line for each thing that is missing somewhere."""
    return [*_boards(root), *_packets(root), *_threads(root), *_functions(root)]


# -- boards -----------------------------------------------------------------------------------


def _boards(root: Path) -> Iterator[str]:
    launch = root / 'launch' / 'bridge.launch'
    given = {tag.get('name'): tag.get('value') for tag in ElementTree.parse(launch).iter('arg')}
    configured = yaml.safe_load((root / 'config' / 'bridge.yaml').read_text())
    folder = root / 'serial_communication' / 'boards'
    for name in sorted(path.parent.name for path in folder.glob('*/__init__.py')):
        if name not in BOARDS:
            yield f'boards/__init__.py: BOARDS has no {name}'
    for name in BOARDS:
        yield from (f'boards/{name}/{file}: there is no such file' for file in FILES
                    if not (folder / name / file).exists())
        if f'{name}_port' not in given:
            yield f'launch/bridge.launch: there is no argument {name}_port'
        if name not in (given['boards'] or '').split():
            yield f'launch/bridge.launch: the argument boards has no {name}'
        if configured.get(name, {}).get('baud') != description(name).baud:
            yield f'config/bridge.yaml: {name} has not the rate of its description'
        yield from _types(root, description(name))


def _types(root: Path, board: Description) -> Iterator[str]:
    """The ROS types of a board that are not in this package, though they should be."""
    for kind, entries in ('msg', board.topics), ('srv', board.services):
        for each in entries:
            name = each.type.partition(_OWN)[2]
            if name and not (root / kind / f'{name}.{kind}').exists():
                yield f'{kind}/{name}.{kind}: there is no such file'


# -- packets ----------------------------------------------------------------------------------


def _packets(root: Path) -> Iterator[str]:
    for name, (header, after, constant) in LINKS.items():
        wire = import_module(f'serial_communication.boards.{name}.wire')
        from_board, to_board = set(wire.FROM_BOARD), set(getattr(wire, 'TO_BOARD', ()))
        for each in _defined_in(wire) - from_board - to_board:
            yield f'boards/{name}/wire.py: {each.__name__} is not in FROM_BOARD or TO_BOARD'
        folder = root / 'serial_communication' / 'boards' / name
        topics = {topic.message for topic in description(name).topics} - {None}
        for each in from_board - topics if topics else ():     # else its ros.py makes them all
            if f'wire.{each.__name__}' not in (folder / 'ros.py').read_text():
                yield f'boards/{name}/__init__.py: no Topic has the message {each.__name__}'
        for each in from_board | to_board:
            if f'wire.{each.__name__}' not in (folder / 'simulator.py').read_text():
                yield f'boards/{name}/simulator.py: {each.__name__} is not simulated'
        numbers = _constants(root, header, after, constant)
        rows = _rows(root, f'{name}: ')
        for type_ in sorted(each.TYPE for each in from_board | to_board):
            if type_ not in numbers:
                yield f'firmware/protocol/src/{header}: the type {type_} is missing'
            if type_ not in rows:
                yield f'{_PAGE}: the type {type_} of the {name} is missing'
        free = re.search(r'kMessageTypes = (\d+)', _header(root, header))
        if free and int(free.group(1)) != 1 + max(
                type_ for type_ in wire.BUILT_IN if type_ < RESERVED):
            yield f'firmware/protocol/src/{header}: kMessageTypes is {free.group(1)}, but not ' \
                'the first free type'


def _defined_in(wire: Any) -> Set[Any]:
    """The message classes that a module defines."""
    return {each for name, each in vars(wire).items() if isinstance(each, type)
            and issubclass(each, LayoutMessage) and hasattr(each, 'TYPE')
            and each.TYPE < RESERVED and name == each.__name__}


def _header(root: Path, name: str) -> str:
    return (root / 'firmware' / 'protocol' / 'src' / name).read_text()


def _constants(root: Path, header: str, after: str, name: str) -> Set[int]:
    """The numbers of the constants in a header of the firmware."""
    text = re.split(after, _header(root, header), 1)[-1].partition('};')[0] if after else \
        _header(root, header)
    return {int(number, 0) for number in re.findall(rf'\b{name} = (0x\w+|\d+)[,;]', text)}


def _rows(root: Path, chapter: str) -> Set[int]:
    """The numbers with which rows of the tables in a chapter begin."""
    page = re.split(r'^## ', (root / _PAGE).read_text(), 0, re.MULTILINE)
    section = next((each for each in page if each.startswith(chapter)), '')
    return {int(number, 0) for number in re.findall(r'^\| (0x\w+|\d+) ', section, re.MULTILINE)}


# -- functions of the bus ---------------------------------------------------------------------


_STOP = 0x2F     # of the reference firmware; the bridge has it in a row only


def _functions(root: Path) -> Iterator[str]:
    numbers = _constants(root, 'robot_ctrl_bus.h', '', r'kFunction\w+')
    rows, names = _rows(root, 'bus: '), description('bus').names
    known = {each.cmd2 for each in bus.BUILT_IN.values()} | {_STOP}
    yield from (f'boards/bus/messages.py: the function 0x{number:02x} of the firmware is missing'
                for number in sorted(numbers - known))
    for each in bus.BUILT_IN.values():
        if each.service and each.service not in names:
            yield f'boards/bus/__init__.py: there is no service {each.service}'
        name = each.srv_type.partition(_OWN)[2]
        if name and not (root / 'srv' / f'{name}.srv').exists():
            yield f'srv/{name}.srv: there is no such file'
        if each.cmd1 != bus.FUNCTION or each is bus.ANNOUNCEMENT:
            continue
        if not _is_simulated(each):
            yield f'boards/bus/simulator.py: {each.name} is not simulated'
        if each.cmd2 not in numbers:
            yield f'firmware/protocol/src/robot_ctrl_bus.h: the function ' \
                f'0x{each.cmd2:02x} is missing'
        if each.cmd2 not in rows:
            yield f'{_PAGE}: the function 0x{each.cmd2:02x} is missing'


def _is_simulated(function: Any) -> bool:
    """Whether the simulated board knows a function of the bus."""
    written: List[bytes] = []
    simulator = import_module('serial_communication.boards.bus.simulator')
    line = SimulatedLine(simulator.BOARD(), written.append)
    line.start(0.0)
    request = function.make_request([0] * len(function.request.values))
    line.receive(bus_wire.encode_request(bus.SYNC_REQUEST) + bus_wire.encode_request(request), 0.0)
    line.tick(5.0)
    replies = [frame.message for frame in bus_wire.ReplyDecoder().feed(b''.join(written))]
    return len(replies) == 2 and replies[1].error_code != bus.UNSUPPORTED


# -- threads of the bridge --------------------------------------------------------------------

_NAMES = {'Thread': 'name', 'HeartbeatThread': 0, 'LatestWorker': 0, 'Opener': 1}    # an argument


def _threads(root: Path) -> Iterator[str]:
    chapter = (root / 'doc' / 'developing.md').read_text().partition('### The threads')[2]
    chapter = chapter.partition('\n## ')[0]
    for layer in 'transport', 'link', 'ros', 'boards':
        for path in (root / 'serial_communication' / layer).rglob('*.py'):
            for name in _thread_names(ast.parse(path.read_text())):
                if f'{name}`' not in chapter and f'`{name} ' not in chapter:
                    yield f'doc/developing.md: the thread "{name}" of {path.name} is missing'


def _thread_names(tree: ast.AST) -> Iterator[str]:
    """The names of the threads that a module makes, as far as they are constant."""
    for node in ast.walk(tree):
        called = getattr(node, 'func', None)
        place = _NAMES.get(getattr(called, 'attr', getattr(called, 'id', '')))
        if isinstance(node, ast.Call) and place is not None:
            given: Dict[Any, ast.AST] = {**dict(enumerate(node.args)), **{
                each.arg: each.value for each in node.keywords}}
            for part in ast.walk(given.get(place, ast.Constant(''))):
                if isinstance(part, ast.Constant) and isinstance(part.value, str) and part.value:
                    yield part.value.strip()


if __name__ == '__main__':
    print('\n'.join(problems(Path(sys.argv[1]))))
