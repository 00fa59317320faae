"""Imports go one way, and in a board's folder the file's name gives its layer:

    transport, framing  ->  link, simulation  ->  ros  ->  boards/X  ->  tools

boards/*.py, the list of boards and their description, imports only framing. The layers before
boards/X find a board there, and name none.
"""
import ast
from pathlib import Path
from typing import Dict, Iterator, Optional, Set

from sources import PACKAGE

# The layers that each layer may import besides itself. In a board's folder, X, each file is a
# layer. A file with another name has the layers of the files that import it.
SHARED = {'boards', 'output', 'framing', 'transport'}
MESSAGES = {'msg', 'srv'}
ALLOWED: Dict[str, Set[str]] = {
    'output': set(),
    'transport': set(),
    'framing': set(),
    'boards': {'framing'},
    'link': {'framing', 'transport'},
    'simulation': SHARED,
    'ros': {*SHARED, *MESSAGES, 'link'},
    'tools': {*SHARED, *MESSAGES, 'link', 'simulation', 'ros', 'X/wire'},
    'X/wire': {'framing'},
    'X/__init__': {'boards', 'framing', 'X/wire'},
    'X/link': {'framing', 'transport', 'link', 'X/__init__', 'X/wire'},
    'X/simulator': {*SHARED, 'simulation', 'X/__init__', 'X/wire'},
    'X/ros': {*SHARED, *MESSAGES, 'link', 'ros', 'X/__init__', 'X/wire', 'X/link'},
}
WITH_ROS = ('ros', 'tools', 'X/ros')
WITHOUT_IO = ('framing', 'X/wire', 'X/__init__')
ROS = {'rospy', 'roslib', 'rospkg', 'rosgraph', 'roslaunch', 'rosbag', 'tf', 'tf2_ros', 'genpy',
       'dynamic_reconfigure'}
IO = {'io', 'logging', 'os', 'queue', 'random', 'select', 'serial', 'signal', 'socket',
      'subprocess', 'sys', 'termios', 'threading', 'time'}


def test_every_layer_imports_only_what_it_may():
    assert sorted(f'{path.relative_to(PACKAGE)} imports {module}'
                  for path in PACKAGE.rglob('*.py') if path != PACKAGE / '__init__.py'
                  for layer in layers(path) for module in imports(path)
                  if not may_import(layer, path, module)) == []


def layers(path: Path) -> Set[str]:
    """Return the layer of a file, or several for a helper in a board's folder."""
    parts = path.relative_to(PACKAGE).with_suffix('').parts
    if parts[0] != 'boards' or len(parts) == 2:
        return {parts[0]}
    if f'X/{parts[2]}' in ALLOWED:
        return {f'X/{parts[2]}'}
    found = [layers(other) for other in path.parent.glob('*.py')
             if other != path and path in map(target, imports(other))]
    return set().union(*found) or {'X/wire'}      # no file imports it


def may_import(layer: str, path: Path, module: str) -> bool:
    """Whether a file of this layer may have this import."""
    found = target(module)
    if found is None:
        top = module.split('.')[0]
        is_ros = top in ROS or top.endswith(('_msgs', '_srvs'))
        return not (is_ros and layer not in WITH_ROS or top in IO and layer in WITHOUT_IO)
    parts = found.relative_to(PACKAGE).with_suffix('').parts
    if not parts or parts[0] != 'boards' or len(parts) == 2:
        return not parts or parts[0] in ALLOWED[layer] | {layer}
    name = f'X/{parts[2]}'
    if path.parent != found.parent:
        return layer == 'tools' and name in ALLOWED[layer]
    return name not in ALLOWED or name in ALLOWED[layer] | {layer}


def target(module: str) -> Optional[Path]:
    """Return the file that an import of this package names; None for another package."""
    top, *parts = module.split('.')
    if top != PACKAGE.name:
        return None
    while parts:
        path = PACKAGE.joinpath(*parts)
        for file in path.with_suffix('.py'), path / '__init__.py':
            if file.is_file():
                return file
        if parts[0] in MESSAGES:
            return PACKAGE / parts[0]
        parts.pop()     # a name in a module
    return PACKAGE


def imports(path: Path) -> Iterator[str]:
    """Yield the full name of each import, including those inside functions."""
    inside = [PACKAGE.name, *path.relative_to(PACKAGE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = inside[:len(inside) - node.level + 1] if node.level else []
            base = base + (node.module.split('.') if node.module else [])
            for alias in node.names:    # a module or a name in one
                yield '.'.join(base + [alias.name])
