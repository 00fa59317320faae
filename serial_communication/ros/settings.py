"""The settings of boards in ROS: a dynamic_reconfigure server for each link that has any.

dynamic_reconfigure's own Server has a fixed list of parameters, and calls the master while it holds
its lock. So this module has the topics and the service of one, with dynamic_reconfigure's messages.
"""
from functools import partial
from typing import Any, Dict, Mapping

import rospy
from dynamic_reconfigure.encoding import decode_config, encode_config
from dynamic_reconfigure.msg import (Config, ConfigDescription, Group, GroupState,
                                     ParamDescription)
from dynamic_reconfigure.srv import Reconfigure, ReconfigureRequest, ReconfigureResponse

from ..framing.layout import FRACTIONS
from ..framing.rows import Setting
from ..link.link import Link
from ..link.settings import State
from .background import LatestWorker
from .publishing import publisher

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


class SettingsServer:
    """The settings of one link.

    Args:
        values: that are wanted at the start, and that the parameter server has, by name.
    """

    def __init__(self, link: Link, values: Dict[str, Any], worker: LatestWorker) -> None:
        self._link = link
        self._settings: Any = link.session.board_settings
        self._settings.wanted.update(values)
        self._set_values = dict(values)     # that the parameter server has
        self._name = f'~{PARAMETER}/{link.name}'
        self._server: Any = ()      # two publishers and a service; empty: there are no settings
        self._described: Any = None         # the description that is published
        self._settings.on_change = partial(worker.submit, self.update)

    def update(self) -> None:
        """Publish the settings, and set the parameters; in the worker's thread."""
        shown = self._settings.shown()
        if shown and not self._server:
            self._server = (
                publisher(self._name + '/parameter_descriptions', ConfigDescription, latch=True),
                publisher(self._name + '/parameter_updates', Config, latch=True),
                rospy.Service(self._name + '/set_parameters', Reconfigure, self._set))
        if shown:
            description = _description(shown)
            if description != self._described:
                self._described = description
                self._server[0].publish(description)
            self._server[1].publish(_config(shown))
        elif self._server:
            descriptions, updates, service = self._server
            self._server, self._described = (), None
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
        shown = self._settings.shown()
        given = {name: value for name, value in decode_config(request.config).items()
                 if name in shown and type(value) is not str}
        for name, value in given.items():
            row = shown[name].row
            self._settings.want(name, min(max(value, row.minimum), row.maximum))
        self._settings.wait(given, _ANSWER)
        shown = self._settings.shown()
        for name in given.keys() & shown.keys():
            state, why = shown[name], ''
            if not state.is_settled:
                why = f'= {state.wanted} is not confirmed by the board yet; it is sent until it is'
            elif state.wanted is not None and state.value != state.wanted:
                why = f'cannot be {state.wanted}: the board uses {state.value}'
                self._settings.want(name, state.value)
            if why:
                self._link.log.warn(f'set {name}', f'the setting {name} {why}')
        return ReconfigureResponse(_config(self._settings.shown()))


def _config(shown: Mapping[str, State]) -> Config:
    values = {}
    for name, each in shown.items():
        value = each.value if each.is_settled and each.value is not None else each.wanted
        values[name] = _type(each.row)(each.row.default if value is None else value)
    config = encode_config(values)
    config.groups.append(GroupState('Default', True, 0, 0))
    return config


def request_of(row: Setting, value: Any) -> Any:
    """Return the request that sets one setting; ValueError for a value that is not allowed."""
    return ReconfigureRequest(encode_config({row.name: _type(row)(row.checked(value))}))


def value_in(response: Any, row: Setting) -> Any:
    """Return the value of a setting in a response; None if it is not there."""
    return decode_config(response.config).get(row.name)


def _type(row: Setting) -> type:
    """The type of a setting in dynamic_reconfigure, whose integers have 32 bits with a sign."""
    return bool if row.code == '?' else float if row.code in ('I', *FRACTIONS) else int


def _description(shown: Mapping[str, State]) -> ConfigDescription:
    rows = [each.row for each in shown.values()]
    types = {bool: 'bool', int: 'int', float: 'double'}

    def encode(limit: str) -> Config:
        return encode_config({row.name: _type(row)(getattr(row, limit)) for row in rows})

    return ConfigDescription([Group('Default', '', [
        ParamDescription(row.name, types[_type(row)], 0, f'{row.description} [{row.unit}]'
                         if row.unit else row.description, '')
        for row in rows], 0, 0)], encode('maximum'), encode('minimum'), encode('default'))
