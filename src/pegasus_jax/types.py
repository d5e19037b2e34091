"""The vocabulary: every value that passes between the pieces, and the signature of every piece.

Index letters, where nothing else is said: K particles, H horizon, D state, U control, F encoded features, N dataset
capacity, M minibatch, T trials, S seeds, E episodes. A piece that draws takes a `key`; a piece that takes noise is
deterministic; none does both. A variant of a piece is another value of its type, never a subclass.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

Array = jax.Array
Key = jax.Array
Params = Any  # a pytree of arrays, opaque to everyone but the piece that made it


class Dataset(NamedTuple):
    """Transitions (x_t, u_t) -> x_{t+1} - x_t in arrays of fixed capacity, so that nothing recompiles as data grows."""

    x: Array  # [N, D] observed state
    u: Array  # [N, V] control as the model is given it; V = U unless the task's memory or hindsight says otherwise
    y: Array  # [N, D] change of state; differences of angles are wrapped to [-pi, pi]
    size: Array  # [] int32, rows in use; the rows beyond are zero
    memory: Array | None = None  # [N, M] the memory in these rows; None: the task has no memory


class Batch(NamedTuple):
    """Rows of a dataset."""

    x: Array  # [M, D]
    u: Array  # [M, V]
    y: Array  # [M, D]


class Trajectory(NamedTuple):
    """One episode on a plant, as the controller saw it. Rows after an early end have no meaning."""

    x: Array  # [H+1, D] observed state
    u: Array  # [H, U] control
    cost: Array  # [H] cost of the states 1..H, without sensor noise where the plant can tell
    length: Array | None = None  # [] int32, the control periods that took place; None: all H
    memory: Array | None = None  # [M] at the start; x and u tell the rest. None: no memory, or nothing was drawn for it


class Prediction(NamedTuple):
    """A model's prediction of the next change of state."""

    mean: Array  # [D] change of state
    std: Array  # [D] standard deviation of the observation noise around it


class Scenarios(NamedTuple):
    """Every random number of K imagined rollouts: with these, a rollout is a deterministic function (PEGASUS)."""

    start: Array  # [K, D + M] first states, Alg. 3 line 5, and what is remembered there
    dynamics: Params  # [K, ...] one draw of the model a particle, Alg. 3 line 1
    policy: Params  # [K, ...] one draw of the policy a particle, Alg. 3 line 2
    sensor: Array  # [H, K, D] standard normal, scales the predicted noise
    match: Array  # [H, K, D + M] standard normal, redraws matched particles, Alg. 3 line 3


class Period(NamedTuple):
    """For how many search iterations each draw is kept; 0 keeps it for the whole search of a trial.

    Alg. 2 is 1 everywhere; Alg. 3 is start=1 and 0 elsewhere.
    """

    start: int = 1
    dynamics: int = 0
    policy: int = 0
    sensor: int = 0
    match: int = 0


class Rollout(NamedTuple):
    """K imagined trajectories."""

    x: Array  # [H+1, K, D + M] states, with what is remembered
    u: Array  # [H, K, U] controls
    std: Array  # [H, K, D] predicted noise of the states 1..H


class Dropout(NamedTuple):
    """Multiplicative noise on the units of a layer, h * z with z = mask(params, noise)."""

    init: Callable[[Key, int], Params]  # (key, width) -> parameters of q(z)
    sample: Callable[[Key, int], Array]  # (key, width) -> base noise [width], free of parameters
    mask: Callable[[Params, Array], Array]  # (params, base noise [width]) -> z [width]
    kl: Callable[[Params], Array]  # KL(q || prior) summed over units [nats]
    retain: Callable[[Params], Array]  # E[z] [width]; [] where it is one number for all units
    decay: Callable[[Params], Array]  # [width] or [], factor of |W_i|^2 / 2 in the prior of the unit's outgoing weights


class Dynamics(NamedTuple):
    """A distribution over functions (x, u) -> change of x, learned from data."""

    init: Callable[[Key], Params]
    prepare: Callable[[Dataset], Any]  # what the loss needs of the whole data set, such as its scaling
    loss: Callable[[Params, Key, Batch, Any], Array]  # (params, key, batch, prepare(data)) -> scalar
    posterior: Callable[[Params, Dataset], Any]  # -> posterior, all that a rollout needs
    sample: Callable[[Key, Any], Params]  # (key, posterior) -> draw: one function, one particle's w^(k)
    # (posterior, draw, x [D], u [U]); a `Vectorized` function also has an implementation for K particles at once
    apply: Callable[[Any, Params, Array, Array], Prediction]
    # (posterior, mean [F + U], cov of (encoded state, control)) -> gaussian.Image of the change; None: not known
    moments: Callable[[Any, Array, Array], Any] | None = None
    deal: Callable[[Key, Any], Params] | None = None  # (keys [K], posterior) -> draws [K, ...]; None: `sample`, vmapped
    penalty: Callable[[Params], Array] | None = None  # N times what the loss has beside the likelihood; None: unknown


class Memory(NamedTuple):
    """What a controller knows exactly beside its newest observation o [O]: m [M], which is computed and not predicted.

    m is what is known before o comes. Where nothing is remembered, m is None (memory.py has the values).
    """

    names: tuple[str, ...]  # of its M entries
    start: Callable[[Key, Array], Any]  # (key, o) -> m, at the first observation of an episode
    advance: Callable[[Any, Array, Array], Any]  # (m, o, u [U]) -> m one control period later
    shown: tuple[str, ...] = ()  # names of what the policy sees beside o; it sees P = O + len(shown) entries
    show: Callable[[Any, Array], Array] = lambda m, o: o[:0]  # (m, o) -> these entries
    shown_angles: tuple[int, ...] = ()  # which of these are angles [rad]
    shown_units: tuple[float, ...] = ()  # how large each of these is, as a network counts it; (): 1
    # (m, u [U]) -> what the model is given in place of the control u [V], such as one of some periods ago; None: u
    applied: Callable[[Any, Array], Array] | None = None
    # Whether moment matching may redraw m together with x. False for what stays the same in an episode, as a goal.
    matched: bool = True
    measured: tuple[int, ...] | None = None  # the entries of o that are looked at; None: all


class Hindsight(NamedTuple):
    """Better estimates of an episode's states, made after it has ended: the model learns from these."""

    # (observations [H+1, D], the last row that took place, controls as the model is given them [H, V]) -> (states
    # [H+1, D], more columns of the controls [H, W], which the fit is given and a rollout is not)
    states: Callable[[Array, Array, Array], tuple[Array, Array]]
    more: int  # W


NO_MEMORY = Memory((), lambda key, o: None, lambda m, o, u: m)


class Policy(NamedTuple):
    """A controller; `apply` returns controls inside the plant's limits."""

    init: Callable[[Key], Params]
    sample: Callable[[Key], Params]  # base noise of one policy draw
    apply: Callable[[Params, Params, Array], Array]  # (params, noise or None: the mean policy, x [D]) -> u [U]
    # (params, mean [F], cov of the encoded state) -> gaussian.Image of the control; None: not known
    moments: Callable[[Params, Array, Array], Any] | None = None
    # (fresh params, data) -> params that take the data's large entries in their own units; None: not needed
    adapt: Callable[[Params, Dataset], Params] | None = None
    memory: Memory = NO_MEMORY  # what it sees beside the observation, if it is more: x [D] above is then [P]


class Cost(NamedTuple):
    """What a search minimizes: a differentiable function of one state, in [0, 1]. x is x' [D + M] in a task."""

    of_state: Callable[[Array], Array]  # x [D] -> scalar
    # (mean [D], cov [D, D]) -> E[cost] of a Gaussian state; None: not in closed form, but by costs.expected_by_nodes
    expected: Callable[[Array, Array], Array] | None = None
    widen: "Callable[[Array | float], Cost] | None" = None  # times the width -> that cost; None: costs.widened


class TrainState(NamedTuple):
    """Parameters with the state of their optimizer."""

    params: Params
    optimizer: Any


class ModelLearner(NamedTuple):
    """How a model learns from the data (Alg. 1 line 5)."""

    init: Callable[[Params], Any]  # parameters -> the optimizer's state
    run: Callable[..., tuple[TrainState, Any]]  # (key, learner, data, steps) -> (learner, FitInfo)


class PolicyOptimizer(NamedTuple):
    """How a policy improves in imagination (Alg. 1 line 6)."""

    init: Callable[[Params], Any]  # parameters -> the optimizer's state
    # (key, learner, posterior, steps=, first=, earlier=, fresh=) -> (learner, SearchInfo): iterations first .. first +
    # steps - 1 of the search after `earlier` others; `fresh` are untrained policies [2, ...], or more. One that refines
    # takes works=, whether the given policy's newest episode succeeded; 2: and the policy after it has failed since
    run: Callable[..., tuple[TrainState, Any]]


class RunState(NamedTuple):
    """All that the next trial needs. The root key never changes: trial t uses fold_in(key, t), so resuming is exact."""

    key: Key
    data: Dataset
    model: TrainState
    policy: TrainState
    trial: Array  # [] int32, episodes added so far
    policy_trial: Array  # [] int32, the trial after which this policy was learned; 0: it has learned nothing yet
    succeeded: Array  # [] bool, whether the newest episode of this policy did
    working: Params  # of the policy to go back to, whose newest episode succeeded: learn/successor.py
    working_trial: Array  # [] int32, the trial after which that was learned; 0: there is none
