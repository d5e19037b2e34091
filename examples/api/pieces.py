"""What the API reference shows of models, policies, imagination and search; it runs from the top to the end.

`jax.eval_shape` stands where a program would take long to compile: it gives shapes, the function itself values.
"""

from functools import partial

import jax
import jax.numpy as jnp
import optax

import pegasus_jax as pg

K, H, D, U = 20, 8, 4, 1  # particles, horizon, entries of the state and of the control
key = jax.random.key(0)
small = dict(model=pg.config.BNN(hidden=(16,)), policy=pg.config.MLP(hidden=(16,)), fit=pg.config.Fit(steps=10))
searching = pg.config.Search(steps=4, particles=K)
config = pg.Config("cartpole", trials=2, search=searching, **small)
task = pg.tasks.make("cartpole")

# build
experiment = pg.build(config)  # pure functions, to jit and vmap
state = experiment.init(key)

# Experiment
print(experiment.task.horizon, experiment.task.state_names)
trajectory = jax.eval_shape(experiment.collect, state)  # jax.jit(experiment.collect)(state) runs an episode
assert (trajectory.x.shape, trajectory.u.shape) == ((26, D), (25, U))

# Trajectory
x = jnp.cumsum(0.1 * jax.random.normal(key, (26, D)), 0)  # of a robot: 25 periods, so 26 observations
trajectory = pg.Trajectory(x, u=jnp.ones((25, U)), cost=jnp.ones(25))

# RunState
state = jax.jit(experiment.add_episode)(state, trajectory)
assert int(state.trial) == 1

# Dataset
data = state.data
assert (data.x.shape, data.u.shape, int(data.size)) == ((1024, D), (1024, U), 25)  # with room for more

# data
batch = jax.eval_shape(lambda key: pg.data.minibatch(key, data, rows=10), key)

# Batch
assert (batch.x.shape, batch.y.shape) == ((10, D), (10, D))  # y: changes of state

# trial
state_after, info = jax.eval_shape(lambda s: pg.trial(s, experiment, episodes=3), state)

# TrialInfo
assert info.evaluation.shape == (3, 25)  # episodes, steps: the cost

# run
study = jax.vmap(pg.run(experiment, trials=2, episodes=3))  # jax.jit(study)(keys) runs all seeds as one program
# -> (RunState, TrialInfo), whose `evaluation` is [seeds, trials, episodes, steps]

# Successor
_, successor = jax.eval_shape(experiment.succeed, state, state.policy.params)
assert successor.cost.shape == (25, K)

# Episode
episode = pg.Episode(trajectory, ended="terminated")  # what `experiment.drive` returns of an environment
assert episode.trajectory.cost.shape == (25,)

# compose
nearer = lambda x, u: 1 - jnp.exp(-(x[0] ** 2) - 0.01 * u[0] ** 2)  # noqa: E731
own = pg.compose(config, task, cost=nearer)  # also dynamics=, policy=, fitter=, searcher=
assert own.task.cost.of_state(jnp.zeros(D + 1)).shape == ()  # the control is an entry of the state then

# Task
assert task.state_names[0] == "x [m]"
shorter = task._replace(horizon=20)

# Signal
reference = pg.Signal(lambda t: jnp.array([jnp.sin(t)]), units=(1.0,))
assert reference.value(0.5).shape == (1,)

# Cost
cost = pg.Cost(lambda x: 1 - jnp.exp(-(x[0] ** 2)))
assert cost.of_state(jnp.zeros(D)).shape == ()

# costs
wide = pg.costs.widened(cost, 2.0)  # felt from twice as far
assert wide.of_state(x[-1]) < cost.of_state(x[-1])
expected = pg.costs.expected_by_nodes(task.cost.of_state)  # of a Gaussian: mean [D], cov [D, D]
assert jax.eval_shape(expected, jnp.zeros(D), jnp.eye(D)).shape == ()

# bnn
dynamics = pg.bnn(
    states=D, controls=U, angles=(3,), hidden=(16,), heteroscedastic=True, dropout=pg.dropouts.log_normal(-10.0)
)

# dynamics_of
dynamics = pg.dynamics_of(pg.config.BNN(hidden=(16,)), task)

# Dynamics
params = dynamics.init(key)
posterior = jax.jit(dynamics.posterior)(params, data)  # all that a rollout needs
draw = jax.jit(dynamics.sample)(key, posterior)  # one function of state and control
prediction = jax.eval_shape(dynamics.apply, posterior, draw, jnp.zeros(D), jnp.zeros(U))

# Prediction
assert (prediction.mean.shape, prediction.std.shape) == ((D,), (D,))

# ensemble
five = pg.ensemble(dynamics, members=5)

# lagrangian
mechanism = pg.lagrangian(
    states=D, controls=U, angles=(3,), rates=(1, 2), dt=0.1, substeps=1, hidden=(16,), activation="silu",
    dropout=pg.dropouts.none(),
)  # fmt: skip

# gp
process = pg.gp(states=D, controls=U, angles=(3,))

# ssgp
sparse = pg.ssgp(states=D, controls=U, angles=(3,), points=50)

# Dropout
noise = pg.dropouts.concrete()
mask = noise.mask(noise.init(key, 16), noise.sample(key, 16))
assert mask.shape == (16,)

# dropouts
assert pg.dropouts.binary(0.1).retain(()).shape in ((), (16,))

# Vectorized
double = pg.Vectorized(lambda scale, x: scale * x, many=lambda scale, x: scale * x)  # x [D]; x [K, D]
assert jax.vmap(double, (None, 0))(2.0, jnp.ones((K, D))).shape == (K, D)

# angles
assert pg.angles.encode(jnp.zeros(D), (3,)).shape == (D + 1,)  # the angle leaves, its sine and cosine come

# gaussian
image = jax.eval_shape(lambda mean, cov: pg.gaussian.sincos(mean, cov, (3,)), jnp.zeros(D), jnp.eye(D))
assert (image.mean.shape, image.cov.shape, image.slope.shape) == ((5,), (5, 5), (D, 5))

# policy_of
policy = pg.policy_of(pg.config.MLP(hidden=(16,)), task)

# Policy
theta = policy.init(key)
assert policy.apply(theta, policy.sample(key), jnp.zeros(D)).shape == (U,)  # within the task's limits

# mlp
encode, saturate = partial(pg.angles.encode, angles=(3,)), lambda v: 10 * jnp.tanh(v)
network = pg.mlp(
    encode=encode, features=D + 1, waves=2, controls=U, hidden=(16,), dropout=pg.dropouts.none(), saturate=saturate,
    initializer="glorot",
)  # fmt: skip

# linear
gains = pg.linear(encode=encode, features=D + 1, waves=2, controls=U, saturate=saturate, saturate_moments=None)

# rbf
bumps = pg.rbf(
    encode=encode, start=lambda key: 0.2 * jax.random.normal(key, (D,)), waves=2, controls=U, num_centers=30,
    saturate=saturate, saturate_moments=None,
)  # fmt: skip

# of_pair
gain = pg.of_pair(lambda key: jax.random.normal(key, (U, D + 1)), lambda gain, features: gain @ features, task)
assert gain.apply(gain.init(key), (), jnp.zeros(D)).shape == (U,)

# Memory, memory
clock = pg.memory.clock(dt=0.1)  # the time since an episode's start is what a controller remembers
m = clock.advance(clock.start(key, jnp.zeros(D)), jnp.zeros(D), jnp.zeros(U))
assert m.shape == (1,)

# Hindsight
smoothed = pg.Hindsight(lambda x, last, u: (x, u[:, :0]), more=0)  # states [H + 1, D] as they were observed

# blocks
start = lambda key: 0.2 * jax.random.normal(key, (D,))  # noqa: E731
parts = pg.blocks(dynamics=dynamics, policy=policy, start=start, particles=K, horizon=H, standardized_noise=False)

# Blocks
assert jax.eval_shape(parts.start, key, posterior).shape == (K, D)

# Period
period = pg.Period(start=1, dynamics=100, policy=1, sensor=1, match=1)  # iterations; 0: a whole search

# draw
scenarios = jax.jit(partial(pg.draw, blocks=parts, period=period))(key, 0, posterior)

# Scenarios
assert (scenarios.start.shape, scenarios.match.shape) == ((K, D), (H, K, D))

# sampler
draws = pg.sampler(parts, period)

# Sampler
assert jax.eval_shape(draws.begin, key, jnp.asarray(3), posterior).sensor.shape == (H, K, D)

# rollout
imagined = jax.jit(partial(pg.rollout, dynamics=dynamics, policy=policy, match=pg.matching.match))
paths = imagined(theta, posterior, scenarios)

# Rollout
assert (paths.x.shape, paths.u.shape, paths.std.shape) == ((H + 1, K, D), (H, K, U), (H, K, D))

# NoiseUse
noise_use = pg.NoiseUse(
    policy=1.0, state=0.0
)  # factors of the predicted noise [D]: on what the policy sees, on the state

# matching
assert jax.eval_shape(pg.matching.match, paths.x[3], scenarios.match[3]).shape == (K, D)

# objective
value = partial(
    pg.objective, dynamics=dynamics, policy=policy, match=pg.matching.keep, cost=pg.costs.of_particles(task.cost)
)
assert jax.eval_shape(jax.grad(value), theta, posterior, scenarios).keys() == theta.keys()  # of the shapes of theta

# TrainState
learner = pg.TrainState(params, optax.adam(1e-3).init(params))

# fit
pieces = dict(prepare=dynamics.prepare, loss=dynamics.loss, optimizer=optax.adam(1e-3))
learner, fitted = jax.eval_shape(lambda s: pg.fit(key, s, data, **pieces, steps=10, batch_size=20), learner)

# FitInfo
assert fitted.skipped.shape == ()  # updates that a gradient which was not finite did not make

# minibatches
fitter = pg.minibatches(dynamics, optax.adamw(1e-3), batch_size=20)

# ModelLearner
learner = pg.TrainState(params, fitter.init(params))

# gradient_search
adam = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3))
begun = pg.TrainState(theta, adam.init(theta))
alg3 = partial(pg.gradient_search, objective=value, sampler=draws, optimizer=adam, steps=4)
improved, found = jax.eval_shape(alg3, key, begun, posterior)

# SearchInfo
assert (found.objective.shape, found.gradient_norm.shape) == ((4,), (4,))  # one entry an iteration

# search_table
table = pg.search_table(4, refine=2, cost_width_start=2.0)

# SearchTable
assert table.cost_width.shape == (1, len(table.action))  # searches T, rows R

# Problem
problem = pg.Problem(lambda params, p, given, row: value(params, p, given), draws, adam, pg.search_table(4))

# searcher
improver = pg.searcher(problem)

# PolicyOptimizer, SearchState
begun = pg.TrainState(theta, improver.init(theta))  # the optimizer is a SearchState: `last` [] is its last objective
assert begun.optimizer.last.shape == ()

# search
improved, found = jax.eval_shape(lambda s: pg.search(key, s, posterior, problem=problem, steps=4), begun)
