"""What the pages are told: items in groups, each with the number of its latest change.

However seldom a page is updated, of an item it gets the newest value, never an old one.
"""
from typing import Any, Collection, Dict, Tuple


class News:
    """Items by group and name."""

    def __init__(self) -> None:
        self.number = 0     # of the latest change
        self._groups: Dict[str, Dict[Any, Tuple[int, Any]]] = {}

    def tell(self, group: str, name: Any, value: Any, most: int = 1000) -> None:
        """Set an item, of a group that keeps the `most` newest; the pages hear of it if it
        differs."""
        items = self._groups.setdefault(group, {})
        if name not in items or items[name][1] != value:
            self.number += 1
            items[name] = self.number, value
            if len(items) > most:
                del items[next(iter(items))]

    def add(self, group: str, value: Any, most: int) -> None:
        """Add an item without a name of its own."""
        self.tell(group, self.number + 1, value, most)

    def since(self, number: int, without: Collection[str] = ()) -> Dict[str, Dict[Any, Any]]:
        """What has changed since the change of this number; 0: everything."""
        found = {group: {name: value for name, (changed, value) in items.items()
                         if changed > number}
                 for group, items in self._groups.items() if group not in without}
        return {group: items for group, items in found.items() if items}
