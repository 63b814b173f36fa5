"""A dialect whose attributes are those of the own form under other names."""

import dataclasses
from typing import ClassVar

from me2e_compress.operators.call import Attributes
from me2e_compress.operators.dialect import Attribute, Dialect


@dataclasses.dataclass(frozen=True)
class RenamedAttributes(Dialect):
    """A library that names the attributes as it likes, in the own form's order.

    Class attributes:
        own_attributes: of the own form.
    """

    own_attributes: ClassVar[tuple[Attribute, ...]]

    def options_to_own(self, attributes: Attributes) -> Attributes:
        """Rename them to the own form's."""
        values = [attributes[each.name] for each in self.attributes]
        names = (each.name for each in self.own_attributes)
        return dict(zip(names, values, strict=True))

    def options_from_own(self, attributes: Attributes) -> Attributes:
        """Rename them to this library's."""
        values = [attributes[each.name] for each in self.own_attributes]
        return dict(zip((each.name for each in self.attributes), values, strict=True))
