"""The settings of boards in ROS: a dynamic_reconfigure server for each link that has any.

dynamic_reconfigure's own Server has a fixed list of parameters, and calls the master while it holds
its lock. So this module has the topics and the service of one, with dynamic_reconfigure's messages.
"""
from functools import partial
from types import SimpleNamespace
from typing import Any, Dict, Iterable, List, Mapping

import rospy
from dynamic_reconfigure.encoding import encode_config, encode_description, get_tree
from dynamic_reconfigure.msg import Config, ConfigDescription
from dynamic_reconfigure.srv import Reconfigure, ReconfigureRequest, ReconfigureResponse

from ..framing.layout import FRACTIONS
from ..framing.rows import RowError, Setting
from ..link.link import Link
from ..link.settings import State
from .latest_worker import LatestWorker
from .parameter import ParameterError

PARAMETER = 'settings'     # of the node: values by link and name
_ANSWER = 0.48             # s that a call waits for the board
_XML_RPC = 2 ** 31         # the parameter server takes no greater integer


def for_xml_rpc(value: Any) -> Any:
    """Return the value with floats for the integers that XML-RPC cannot carry."""
    if isinstance(value, dict):
        return {key: for_xml_rpc(each) for key, each in value.items()}
    if isinstance(value, list):
        return [for_xml_rpc(each) for each in value]
    return float(value) if type(value) is int and not -_XML_RPC <= value < _XML_RPC else value


def start_values(given: Any) -> Dict[str, Dict[str, Any]]:
    """Return the parameter `settings`; ValueError if it is not values by link and name."""
    if type(given) is not dict or not all(
            type(values) is dict and all(type(value) in (bool, int, float)
                                         for value in values.values())
            for values in given.values()):
        raise ValueError('may be values by link and name, as {arduino: {kp: 2.0}}')
    return given


def wanted_values(links: Iterable[Link]) -> Dict[str, Dict[str, Any]]:
    """Return the values that are wanted now, as `start_values`."""
    return {link.name: for_xml_rpc(dict(link.session.board_settings.wanted)) for link in links
            if link.session.board_settings and link.session.board_settings.wanted}


class SettingsServer:
    """The settings of one link.

    Args:
        rows: that are there at the start.
        values: that are wanted at the start, and that the parameter server has, by name.
        worker: calls the master.

    Raises:
        ParameterError: a value that its row does not allow.
    """

    def __init__(self, link: Link, rows: Iterable[Setting], values: Dict[str, Any],
                 worker: LatestWorker) -> None:
        for row in rows:
            value = values.get(row.name, row.default)
            try:
                row.checked(value)
            except ValueError as error:
                name = rospy.resolve_name(f'~{PARAMETER}/{link.name}/{row.name}')
                raise ParameterError(f'parameter {RowError(name, value, str(error))}') from None
        self._link = link
        self._settings: Any = link.session.board_settings
        self._settings.wanted.update(values)
        self._set_values = dict(values)     # that the parameter server has
        self._worker = worker
        self._name = f'~{PARAMETER}/{link.name}'
        self._server: Any = None    # two publishers and a service; None: there are no settings
        self._rows: List[Setting] = []      # that are published
        self._settings.on_change = partial(worker.submit, self.update)

    def update(self) -> None:
        """Publish the settings, and set the parameters; in the worker's thread."""
        shown = self._settings.shown()
        if shown and not self._server:
            self._server = (
                rospy.Publisher(self._name + '/parameter_descriptions', ConfigDescription,
                                latch=True, queue_size=10),
                rospy.Publisher(self._name + '/parameter_updates', Config, latch=True,
                                queue_size=10),
                rospy.Service(self._name + '/set_parameters', Reconfigure, self._set))
        if shown:
            descriptions, updates, _ = self._server
            rows = [each.row for each in shown.values()]
            if rows != self._rows:
                descriptions.publish(_description(rows))
                self._rows = rows
            updates.publish(_config(shown))
        elif self._server:
            descriptions, updates, service = self._server
            self._server, self._rows = None, []
            service.shutdown()
            descriptions.unregister()
            updates.unregister()
        # For the next start:
        for name, each in shown.items():
            if each.wanted is not None and each.wanted != self._set_values.get(name):
                rospy.set_param(f'{self._name}/{name}', for_xml_rpc(each.wanted))
                self._set_values[name] = each.wanted

    def _set(self, request: Any) -> Any:
        """Want the values of a request; return those that the board uses then."""
        config, shown = request.config, self._settings.shown()
        given = {each.name: each.value for each in (*config.bools, *config.ints, *config.doubles)
                 if each.name in shown}
        for name, value in given.items():
            row = shown[name].row
            self._settings.want(name, min(max(value, row.minimum), row.maximum))
        self._settings.wait(given, _ANSWER)
        for name, each in self._settings.shown().items():
            if name in given and not each.is_settled:
                self._link.log.warn(f'set {name}', f'the setting {name} = {each.wanted} is not '
                                    'confirmed by the board yet; it is sent until it is')
            elif name in given and each.wanted is not None and each.value != each.wanted:
                self._link.log.warn(f'set {name}', f'the setting {name} cannot be {each.wanted}: '
                                    f'the board uses {each.value}')
                self._settings.want(name, each.value)
        return ReconfigureResponse(_config(self._settings.shown()))


def _config(shown: Mapping[str, State]) -> Any:
    values = {}
    for name, each in shown.items():
        value = each.value if each.is_settled and each.value is not None else each.wanted
        values[name] = _type(each.row)(each.row.default if value is None else value)
    return encode_config({**values, 'groups': get_tree(
        _description([each.row for each in shown.values()]))})


def request_of(row: Setting, value: Any) -> Any:
    """Return the request that sets one setting; ValueError for a value that is not allowed."""
    return ReconfigureRequest(encode_config({row.name: _type(row)(row.checked(value))}))


def value_in(response: Any, row: Setting) -> Any:
    """Return the value of a setting in a response; None if it is not there."""
    config = response.config
    return next((each.value for each in (*config.bools, *config.ints, *config.doubles)
                 if each.name == row.name), None)


def _type(row: Setting) -> type:
    """The type of a setting in dynamic_reconfigure, whose integers have 32 bits with a sign."""
    return bool if row.code == '?' else float if row.code in ('I', *FRACTIONS) else int


def _description(rows: List[Setting]) -> Any:
    types = {row.name: _type(row) for row in rows}
    return encode_description(SimpleNamespace(
        min={row.name: types[row.name](row.minimum) for row in rows},
        max={row.name: types[row.name](row.maximum) for row in rows},
        defaults={row.name: types[row.name](row.default) for row in rows},
        config_description={
            'name': 'Default', 'id': 0, 'parent': 0, 'type': '', 'groups': [],
            'parameters': [{
                'name': row.name, 'level': 0, 'edit_method': '',
                'type': {bool: 'bool', int: 'int', float: 'double'}[types[row.name]],
                'description': f'{row.description} [{row.unit}]' if row.unit else row.description,
            } for row in rows]}))
