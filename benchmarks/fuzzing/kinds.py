"""All kinds of bad input."""

from fuzzing import commands, diagnoses, examinations, files, frames, own_effects, places, settings
from fuzzing.laws import Kind

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in [
        *files.KINDS,
        *frames.KINDS,
        *settings.KINDS,
        *places.KINDS,
        *commands.KINDS,
        *own_effects.KINDS,
        *diagnoses.KINDS,
        *examinations.KINDS,
    ]
}
