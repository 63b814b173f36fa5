"""Dialects that only rename the attributes of the own form."""

import dataclasses
from typing import ClassVar

from me2e_compress.operators.call import Attributes
from me2e_compress.operators.dialect import Attribute, Dialect


@dataclasses.dataclass(frozen=True)
class RenamedAttributes(Dialect):
    """A library with its own names for the attributes, in the own form's order.

    Class attributes:
        own_attributes: those of the own form.
    """

    own_attributes: ClassVar[tuple[Attribute, ...]]

    def options_to_own(self, attributes: Attributes) -> Attributes:
        """Rename them to the own form's names."""
        values = [attributes[each.name] for each in self.attributes]
        names = (each.name for each in self.own_attributes)
        return dict(zip(names, values, strict=True))

    def options_from_own(self, attributes: Attributes) -> Attributes:
        """Rename them to this library's names."""
        values = [attributes[each.name] for each in self.own_attributes]
        return dict(zip((each.name for each in self.attributes), values, strict=True))
