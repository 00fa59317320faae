"""The report of `monitor --report`: what an issue needs, without secrets. It opens no port."""
import platform
import re
from contextlib import suppress
from typing import Any, List

import rospkg
import yaml

from ..ports.devices import devices, holders_of
from ..watch.state import BridgeState
from ..watch.table import LEVELS

_SECRET = re.compile('pass|secret|token|credential|api_?key', re.IGNORECASE)    # in names
_HOST = re.compile(r'(\w://)(?:\S*@)?[^/?\s]+?(?=[/?\s]|: |$)', re.MULTILINE)    # in a URL
_HIDDEN = '…'


def of_computer() -> str:
    """The versions, the system and the serial ports of this computer."""
    versions = f'{_version("serial_communication")}, {_version("rospy")}'
    system = f'Python {platform.python_version()}, {_system()}, {platform.machine()}, ' \
        f'Linux {platform.release()}'
    ports = [', '.join(filter(None, (device.path, device.adapter, *holders_of(device.path))))
             for device in devices()]
    return '\n'.join([versions, system, *_section('ports', ports or ['none'])])


def of_bridge(bridge: BridgeState) -> str:
    """All values of /diagnostics, and the parameters: without hosts and secrets."""
    values = [line for name, link in bridge.links.items() for line in (
        [f'{name}  {LEVELS[min(link.level, len(LEVELS) - 1)]}  {link.summary}']
        + [f'  {key}: {value}' for key, value in link.values.items()]
        if link else [f'{name}  no report'])]
    parameters = yaml.safe_dump(_without_secrets(bridge.parameters), default_flow_style=False,
                                allow_unicode=True).splitlines()
    return _HOST.sub(rf'\1{_HIDDEN}', '\n'.join(
        _section('diagnostics', values) + _section('parameters', parameters)))


def _section(title: str, lines: List[str]) -> List[str]:
    return ['', f'{title}:', *(f'  {line}' for line in lines)]


def _version(package: str) -> str:
    try:
        return f'{package} {rospkg.RosPack().get_manifest(package).version}'
    except (rospkg.ResourceNotFound, rospkg.InvalidManifest):
        return f'{package} ?'


def _system() -> str:
    """The name of the distribution."""
    with suppress(OSError), open('/etc/os-release', encoding='utf-8', errors='replace') as file:
        return ''.join(re.findall(r'^PRETTY_NAME="?(.*?)"?$', file.read(), re.MULTILINE))
    return 'unknown system'


def _without_secrets(value: Any, name: str = '') -> Any:
    if isinstance(value, dict):
        return {key: _without_secrets(each, key) for key, each in value.items()}
    return _HIDDEN if _SECRET.search(name) else value
