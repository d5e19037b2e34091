from collections.abc import Sequence


class JointState:
    def __init__(
        self,
        *,
        name: Sequence[str] = (),
        position: Sequence[float] = (),
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> None:
        self.name, self.position, self.velocity, self.effort = name, position, velocity, effort
