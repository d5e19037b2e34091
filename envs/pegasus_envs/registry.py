"""Names under which Gymnasium knows the plants. Kept free of JAX and MuJoCo, since Gymnasium's import runs this."""

from typing import Any

_TASKS = {
    "KnifeEdge": "knife_edge",
    "BellyUp": "belly_up",
    "Corkscrew": "corkscrew",
    "DepthChange": "depth_change",
}

CONSTRUCTORS: dict[str, tuple[str, dict[str, Any]]] = {
    "pegasus/CartPoleSwingUp-v0": ("pegasus_envs.cartpole:cartpole", {}),
    "pegasus/DoubleCartPole-v0": ("pegasus_envs.double_cartpole:double_cartpole", {}),
    **{
        f"pegasus/Swimmer{legs}{name}-v0": ("pegasus_envs.swimmer.plant:swimmer", {"task": task, "legs": legs})
        for legs in (2, 6)
        for name, task in _TASKS.items()
    },
}
"""id -> constructor of the plant, `module:function`, and its arguments"""

IDS = tuple(CONSTRUCTORS)


def register() -> None:
    """Make the ids known to Gymnasium; those that already are stay untouched."""
    from gymnasium.envs import registration

    for name, (constructor, arguments) in CONSTRUCTORS.items():
        if name not in registration.registry:
            registration.register(
                name,
                entry_point="pegasus_envs.gym_env:PlantEnv",
                kwargs={"plant": constructor, "arguments": arguments},
                # The plant's own horizon truncates; Gymnasium's wrapper would count a second time.
                max_episode_steps=None,
            )
