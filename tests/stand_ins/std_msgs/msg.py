class Float64MultiArray:
    def __init__(self, *, data: list[float] | None = None) -> None:
        self.data = [] if data is None else data
