class SetBool:
    class Request:
        def __init__(self, *, data: bool = False) -> None:
            self.data = data

    class Response:
        def __init__(self) -> None:
            self.success, self.message = False, ""
