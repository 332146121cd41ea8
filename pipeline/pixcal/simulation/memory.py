"""State that an effect carries from frame to frame, wherever a simulation begins."""

from dataclasses import dataclass
from typing import Any

from pixcal.model.arrays import F32
from pixcal.simulation.shot import Shot

KEPT = 3  # arrays of the size of a frame's charge and noise, at most


@dataclass(frozen=True)
class Memory:
    """How a frame depends on the ones before it."""

    frames: int  # number of preceding frames that count
    fades: bool = False  # whether all others count as well, but hardly
    cleared: bool = True  # whether it is empty when a recording begins

    @property
    def block(self) -> int:
        """Frames for which a state that began before them is used."""
        # At least twice the memory, so that few frames prepare the next block; a power of two, as
        # the frames of a task of a simulation.
        return 1 << (2 * self.frames - 1).bit_length() if self.fades else 1


class Carried:
    """State that an effect of a chain (number ``at``) carries from frame to frame.

    Frames may come in any order; those in the order of time cost one step each. A memory that
    fades never forgets exactly, so a state depends on where it began. It begins empty, the frames
    of its memory before each block of frames, and is used in that block alone: frames do not
    depend on where a simulation begins. Two states at most are carried at a time.
    """

    def __init__(self, effect: Any, at: int) -> None:
        # A model with a memory, of `pixcal.simulation.forward`.
        self._effect, self._at, self._memory = effect, at, effect.memory
        self._recording: Any = None  # of the last frame
        self._next = 0  # number of the frame that finds these states
        self._first = 0  # earliest block with a state
        self._states: dict[int, F32] = {}  # by block

    def charge(self, charge: F32, chain: Any, frame: int) -> F32:
        """Charge (y, x) of a frame after the effect, from that before it, e-."""
        number, memory = self._number(chain, frame), self._memory
        block = number // memory.block if memory.fades else 0
        begin = block * memory.block if memory.fades else number
        begin = max(begin - memory.frames, self._number(chain, 0) if memory.cleared else 0)
        goes_on = self._recording in (chain.recording, chain.recording.before)
        if self._recording is None or not (goes_on and begin <= self._next <= number):
            self._states, self._first, self._next = {}, block, begin
        for earlier in range(self._next, number):
            other, n = chain.of(frame - number + earlier)
            self._step(other.charge(n, self._at), other, n)
        return self._step(charge, chain, frame)

    def _step(self, charge: F32, chain: Any, frame: int) -> F32:
        number, memory = self._number(chain, frame), self._memory
        shot = Shot(chain, frame, self._at)
        blocks = range(1)
        if memory.fades:
            now, last = number // memory.block, (number + memory.frames) // memory.block
            blocks = range(max(now, self._first), last + 1)
        made: dict[int, tuple[F32, F32]] = {
            n: self._effect.carry(charge, self._states.get(n), shot) for n in blocks
        }
        self._states = {n: state for n, (_, state) in made.items()}
        self._recording, self._next = chain.recording, number + 1
        return made[blocks[0]][0]

    def _number(self, chain: Any, frame: int) -> int:
        """Number of a frame among those of all recordings up to its own."""
        earlier = chain.recording.before
        while earlier is not None:
            frame, earlier = frame + earlier.count, earlier.before
        return frame
