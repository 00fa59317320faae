"""Imports the boards of other packages and checks their interfaces.

Every mistake there is reported in one line, since a traceback would not name the parameter.
"""
import re
import threading
import time
from typing import Any, Iterable, Iterator, List, Tuple, Type

import rospy

from ..boards import BoardError, description, load
from ..framing.layout import brief
from .interface import Interface
from .parameter import Parameter

_LOOK_EVERY = 0.1     # s between checks whether the import or the node has ended
_SLOW = 3.0           # s after which an import is reported as slow
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')


def board_interfaces(names: Any, taken: Iterable[str]) -> List[Type[Interface]]:
    """Return the interfaces of the boards in these packages.

    Args:
        names: import names of the packages.
        taken: names that no board may have.

    Raises:
        ValueError: one of them cannot be used; the text is one line.
        rospy.ROSInterruptException: the node was stopped during an import.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError
    interfaces: List[Type[Interface]] = []
    for name in names:
        described, interface = _load(name)
        if interface is None:
            raise ValueError(f'the module {name!r}: its ros.py has no INTERFACE')
        mistakes = _mistakes(described, interface, {*taken, *(each.NAME for each in interfaces)})
        for what, given, allowed in mistakes:
            raise ValueError(f'the module {name!r}: INTERFACE{what} is {brief(given, 60)}, '
                             f'may be {allowed}')
        interfaces.append(interface)
    return interfaces


def _load(name: str) -> Tuple[str, Any]:
    """Return the name in its DESCRIPTION, and its INTERFACE (None without one).

    The import runs in a thread, so that a signal ends the node even if the import hangs.
    """
    outcome: List[Any] = []

    def run() -> None:
        try:
            board = description(name)
            outcome.append((board.name, getattr(load(board.package + '.ros'), 'INTERFACE', None)))
        except BoardError as error:
            outcome.append(error)

    thread = threading.Thread(target=run, name=f'import {name}', daemon=True)
    thread.start()
    began, reported = time.monotonic(), False
    while thread.is_alive():
        thread.join(_LOOK_EVERY)
        if rospy.is_shutdown():
            raise rospy.ROSInterruptException(f'while {name} was imported')
        if not reported and time.monotonic() > began + _SLOW:
            reported = True
            rospy.logwarn(f'parameter {rospy.resolve_name("~boards")}: the module {name!r} is '
                          f'still being imported after {_SLOW:g} s; Ctrl-C ends the node')
    if isinstance(outcome[0], BoardError):
        raise ValueError(str(outcome[0]))
    return outcome[0]


def _mistakes(described: str, interface: Any,
              taken: Iterable[str]) -> Iterator[Tuple[str, Any, str]]:
    """Yield what is wrong with an INTERFACE: which part, its value, and what it may be.

    Only the first one counts: what follows it may raise anything.
    """
    if not isinstance(interface, type) or Interface not in interface.__mro__:
        yield '', interface, 'a class derived from serial_communication.ros.interface.Interface'
    name: Any = getattr(interface, 'NAME', None)
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        yield '.NAME', name, 'letters, digits and _, a letter first'
    if name in taken:
        yield '.NAME', name, 'a name that no other board or parameter has'
    if described != name:
        yield '.NAME', name, f'{described!r}, the name in its DESCRIPTION'
    parameters: Any = getattr(interface, 'PARAMETERS', None)
    if not isinstance(parameters, dict):
        yield '.PARAMETERS', parameters, 'a dict from name to Parameter'
    for key, parameter in parameters.items():
        if not isinstance(key, str) or not _NAME.fullmatch(key):
            yield '.PARAMETERS', key, 'a dict from name (letters, digits and _) to Parameter'
        where = f'.PARAMETERS[{key!r}]'
        if not isinstance(parameter, Parameter):
            yield where, parameter, 'a Parameter'
        default = parameter.default
        if type(default) not in (bool, str, int, float, list, dict):
            yield where + '.default', default, 'true or false, text, a number, a list or a group'
        if parameter.parse is None and (default == [] or isinstance(default, dict)):
            yield where + '.parse', None, 'a function if the default is empty or a group'
    if 'port' not in parameters or not isinstance(parameters['port'].default, str):
        yield ".PARAMETERS['port']", parameters.get('port'), 'PORT, which is required'
    mounts: Any = getattr(interface, 'MOUNTS', None)
    if not isinstance(mounts, (tuple, list)) or not all(isinstance(each, str) for each in mounts):
        yield '.MOUNTS', mounts, 'a tuple of sensor names'
    for each in mounts:
        for key in f'{each}_frame_id', f'{each}_mount':
            if key not in parameters:
                yield '.MOUNTS', mounts, f'sensor names; PARAMETERS has no {key}'
