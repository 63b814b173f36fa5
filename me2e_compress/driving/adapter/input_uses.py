"""The feed of each input of a graph, whether or not the model could drive."""

from collections.abc import Mapping

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.feeds import Feed
from me2e_compress.driving.adapter.image_inputs import ImageInput
from me2e_compress.driving.adapter.input_images import InputImages
from me2e_compress.driving.adapter.inputs import (
    ModelInputs,
    feeds_by_input,
    image_tables,
    images_by_input,
    unfed,
)
from me2e_compress.driving.adapter.port_use import PortUse, element_type
from me2e_compress.driving.adapter.recurrent import ZEROS
from me2e_compress.driving.input_sources import INPUT_SOURCES
from me2e_compress.driving.ports import DEFAULT_IMAGE_SIZE, zeros
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.session import DTYPES, SessionPort


def input_uses(
    session: AnySession, adapter: Adapter, recurrent: Mapping[str, str]
) -> tuple[PortUse, ...]:
    """List the inputs of a graph, in its order, with what each is fed."""
    # what can be made, and why the rest cannot
    ports = {k: v for k, v in session.inputs.items() if k not in recurrent}
    tables = {k: v for k, v in image_tables(adapter, ports).items() if k in ports}
    given = {k: v for k, v in feeds_by_input(adapter, ports).items() if k in ports}
    images, problems = _images(session, adapter, tables)
    size = next((each.rendered for each in images.values()), DEFAULT_IMAGE_SIZE)
    problems |= ModelInputs(session.inputs, adapter, images, given, size).faults()
    # each input's feed in words
    words = {
        name: f"{answer} of the frame before" for name, answer in recurrent.items()
    }
    words |= {name: image_words(table) for name, table in tables.items()}
    words |= {name: feed_words(feed) for name, feed in given.items()}
    # faults of types and first values
    for name, port in session.inputs.items():
        if port.type not in DTYPES:
            problems[name] = f"input {name} is {port.type}: it cannot be fed"
        elif name in recurrent:
            entry = (adapter.recurrent or {}).get(name)
            if entry is None or entry.first == ZEROS:
                problems |= _no_start(name, port)
        elif name not in words:
            problems[name] = unfed(name)
    return tuple(
        PortUse(
            name,
            port.shape,
            element_type(port.type),
            words.get(name),
            problems.get(name, ""),
        )
        for name, port in session.inputs.items()
    )


def image_words(table: ImageInput) -> str:
    """Tell which cameras an image shows."""
    count = len(table.cameras)
    words = "the six cameras" if count == 6 else ", ".join(table.cameras)
    return f"{words}, side by side" if table.stitch else words


def feed_words(feed: Feed) -> str:
    """Tell what an input is made of, with the options that were chosen."""
    return ", ".join(INPUT_SOURCES.text(part.source) for part in feed.parts)


def _images(
    session: AnySession, adapter: Adapter, tables: Mapping[str, ImageInput]
) -> tuple[dict[str, InputImages], dict[str, str]]:
    """Return the image inputs that can be made, and why the others cannot."""
    found: dict[str, InputImages] = {}
    problems: dict[str, str] = {}
    for name, table in tables.items():
        try:
            made, _ = images_by_input(session, adapter, {name: table})
        except EvaluationError as error:
            problems[name] = str(error)
        else:
            found |= made
    return found, problems


def _no_start(name: str, port: SessionPort) -> dict[str, str]:
    try:
        zeros(name, port)
    except EvaluationError as error:
        return {name: str(error)}
    return {}
