"""Pictures of plants, with or without a display."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings declare few of their names.)

import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from typing import Any, Protocol

import jax
import mujoco
import numpy as np

_ADVICE = (
    "Cannot draw: no way of drawing without a display works here. Install EGL or OSMesa, for example `apt-get "
    "install libegl1 libopengl0 libgl1-mesa-dri` or `apt-get install libosmesa6`, or set MUJOCO_GL to one that works."
)


def graphics_context(width: int, height: int) -> Any:
    """A current OpenGL context: the one MUJOCO_GL names, else a window's where there is a display, else EGL or OSMesa.

    MuJoCo reads MUJOCO_GL when it is first imported, which is too early to find out what works, so this asks itself.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform != "linux"
    names = [asked] if asked in ("egl", "osmesa", "glfw") else ["glfw"] * bool(display) + ["egl", "osmesa"]
    failures = []
    for name in names:
        before = set(sys.modules)
        platform = os.environ.get("PYOPENGL_PLATFORM")
        try:
            context = import_module(f"mujoco.{name}").GLContext(width, height)
            context.make_current()
            if name == "glfw" and not import_module("glfw").get_current_context():
                raise RuntimeError("no window can be opened")  # GLFW itself only warns
            return context
        except Exception as error:
            failures.append(f"{name}: {error or type(error).__name__}")
            _forget(set(sys.modules) - before, platform)
    raise RuntimeError("\n  ".join([_ADVICE, *failures]))


def without_display() -> None:
    """Set MUJOCO_GL, unless it is set, to what draws here without a display: Gymnasium would take a window's."""
    if "MUJOCO_GL" not in os.environ:
        with suppress(RuntimeError):  # whoever draws then says it better
            context = graphics_context(16, 16)
            context.free()
            os.environ["MUJOCO_GL"] = type(context).__module__.rpartition(".")[2]


def _forget(modules: set[str], platform: str | None) -> None:
    """Undo a failed import of OpenGL, which else fixes the platform for the life of the process."""
    for module in modules:
        if module.split(".")[0] == "OpenGL" or module.startswith(("mujoco.egl", "mujoco.osmesa")):
            sys.modules.pop(module, None)
    if platform is None:
        os.environ.pop("PYOPENGL_PLATFORM", None)


class Drawn(Protocol):
    """What drawing needs of a plant."""

    @property
    def model(self) -> Any: ...
    @property
    def qpos(self) -> Any: ...


class Renderer:
    """Draws states of one plant, as its first camera sees them.

    Holds a graphics context, so close it (or use it in a `with`).
    """

    def __init__(self, plant: Drawn, width: int = 640, height: int = 480):
        self._qpos, self._model, self._size = plant.qpos, plant.model, (width, height)
        self._data = mujoco.MjData(plant.model)
        self._context: Any = graphics_context(width, height)
        self._drawing = mujoco.MjrContext(plant.model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        self._scene = mujoco.MjvScene(plant.model, maxgeom=1000)
        self._camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(plant.model, self._camera)
        if plant.model.ncam:
            self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0

    def __call__(self, state: Any) -> np.ndarray:
        """A picture [height, width, 3] of 8-bit colors."""
        width, height = self._size
        self._data.qpos[:] = np.asarray(self._qpos(state))
        mujoco.mj_forward(self._model, self._data)
        self._context.make_current()
        every, option = mujoco.mjtCatBit.mjCAT_ALL, mujoco.MjvOption()
        mujoco.mjv_updateScene(self._model, self._data, option, None, self._camera, every, self._scene)
        area, picture = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(area, self._scene, self._drawing)
        mujoco.mjr_readPixels(picture, None, area, self._drawing)
        return np.ascontiguousarray(picture[::-1])

    def close(self) -> None:
        """Free the graphics memory; the renderer cannot draw again."""
        if self._context is not None:
            self._context.make_current()
            self._drawing.free()
            self._context.free()
            self._context = None

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def frames(plant: Drawn, states: Iterable[Any], width: int = 640, height: int = 480) -> list[np.ndarray]:
    """Pictures [height, width, 3] of a sequence of states."""
    with Renderer(plant, width, height) as draw:
        return [draw(state) for state in states]


def unstack(states: Any) -> list[Any]:
    """A pytree of stacked states, as `jax.lax.scan` returns it -> the list of the states, on the host."""
    leaves, structure = jax.tree.flatten(jax.tree.map(np.asarray, states))
    return [jax.tree.unflatten(structure, entries) for entries in zip(*leaves, strict=True)]
