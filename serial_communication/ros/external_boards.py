"""Imports the boards of other packages and checks their interfaces.

Every mistake there is reported in one line, since a traceback would not name the parameter.
"""
import re
import threading
import time
from typing import Any, Iterable, List, Tuple, Type

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
        wrong = _wrong(described, interface, {*taken, *(each.NAME for each in interfaces)})
        if wrong:
            raise ValueError(f'the module {name!r}: {wrong}')
        interfaces.append(interface)
    return interfaces


def _load(name: str) -> Tuple[str, Any]:
    """Return the name in its DESCRIPTION, and its INTERFACE (None without one).

    The import runs in a thread, so that a signal ends the node even if the import hangs.
    """
    outcome: List[Any] = []
    thread = threading.Thread(target=_import, args=(name, outcome), name=f'import {name}',
                              daemon=True)
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


def _import(name: str, outcome: List[Any]) -> None:
    try:
        board = description(name)
        outcome.append((board.name, getattr(load(board.package + '.ros'), 'INTERFACE', None)))
    except BoardError as error:
        outcome.append(error)


def _wrong(described: str, interface: Any, taken: Iterable[str]) -> str:
    """Return what is wrong with an INTERFACE, or ''."""
    if interface is None:
        return 'its ros.py has no INTERFACE'
    if not isinstance(interface, type) or Interface not in interface.__mro__:
        return _other('', interface, 'a class derived from '
                      'serial_communication.ros.interface.Interface')
    name = getattr(interface, 'NAME', None)
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        return _other('.NAME', name, 'letters, digits and _, a letter first')
    if name in taken:
        return _other('.NAME', name, 'a name that no other board or parameter has')
    if described != name:
        return _other('.NAME', name, f'{described!r}, the name in its DESCRIPTION')
    parameters = getattr(interface, 'PARAMETERS', None)
    if not isinstance(parameters, dict):
        return _other('.PARAMETERS', parameters, 'a dict from name to Parameter')
    for key, parameter in parameters.items():
        wrong = _wrong_parameter(key, parameter)
        if wrong:
            return wrong
    if 'port' not in parameters or not isinstance(parameters['port'].default, str):
        return _other(".PARAMETERS['port']", parameters.get('port'), 'PORT, which is required')
    return _wrong_mounts(getattr(interface, 'MOUNTS', None), parameters)


def _wrong_parameter(key: Any, parameter: Any) -> str:
    if not isinstance(key, str) or not _NAME.fullmatch(key):
        return _other('.PARAMETERS', key, 'a dict from name (letters, digits and _) to Parameter')
    where = f'.PARAMETERS[{key!r}]'
    if not isinstance(parameter, Parameter):
        return _other(where, parameter, 'a Parameter')
    default = parameter.default
    if type(default) not in (bool, str, int, float, list, dict):
        return _other(where + '.default', default, 'true or false, text, a number, a list or a '
                      'group')
    if parameter.parse is None and (default == [] or isinstance(default, dict)):
        return _other(where + '.parse', None, 'a function if the default is empty or a group')
    return ''


def _wrong_mounts(mounts: Any, parameters: dict) -> str:
    if not isinstance(mounts, (tuple, list)) or not all(isinstance(each, str) for each in mounts):
        return _other('.MOUNTS', mounts, 'a tuple of sensor names')
    for each in mounts:
        for key in f'{each}_frame_id', f'{each}_mount':
            if key not in parameters:
                return _other('.MOUNTS', mounts, f'sensor names; PARAMETERS has no {key}')
    return ''


def _other(what: str, given: Any, allowed: str) -> str:
    return f'INTERFACE{what} is {brief(given, 60)}, may be {allowed}'
