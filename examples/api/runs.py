"""What the API reference shows of runs and their files; it runs from the top to the end, in any folder."""

import numpy as np

import pegasus_jax as pg

small = {"model.hidden": [8], "fit.steps": 5, "search.steps": 4, "eval_episodes": 0, "trials": 1}

# preset
config = pg.preset("cartpole", model="log_normal", settings={"trials": 2})

# Config
assert (config.task, config.trials, config.model.kind) == ("cartpole", 2, "bnn")

# config
own = pg.Config("cartpole", policy=pg.config.MLP(hidden=(50, 50)), search=pg.config.Search(particles=200))

# ConfigError
try:
    pg.preset("cartpole", settings={"search.partciles": 200})
except pg.ConfigError as error:
    print(error)  # one line, with the nearest name

# tasks
task = pg.tasks.make("cartpole")
assert task.state_names[0] == "x [m]"

# load_logs
rows = [f"{0.1 * np.sin(t)},{0.1 * np.cos(t)},0,{0.01 * t},{np.sin(t)}" for t in range(26)]
with open("cart.csv", "w") as file:
    file.write("\n".join(["x,dx,omega,theta,force", *rows]))
(log,) = pg.load_logs("cart.csv", task, columns=["x", "dx", "omega", "theta", "force"])
assert (log.x.shape, log.u.shape) == ((26, 4), (25, 1))  # [H + 1, D], [H, U]

# delay_of
rng = np.random.default_rng(0)
u = rng.uniform(-1, 1, (200, 1))
x = np.zeros((201, 1))
for t in range(2, 200):
    x[t + 1] = 0.9 * x[t] + u[t - 2]  # a control acts two periods late
delay = pg.delay_of([(x, u)])

# Delay
assert delay.periods == 2
assert delay.probabilities.shape == (10,)  # of 0 to 8 periods, and of none

# train
tiny = pg.preset("cartpole", model="deterministic", policy="linear", settings=small)
run = pg.train(tiny, out="runs/tiny")  # pg.train(resume=run, settings={"trials": 2}) goes on

# controller
control = pg.controller(run)  # trial="best", "last" or a number

# Controller
control.reset()  # before every episode
assert control([0.0, 0.0, 0.0, 3.1]).shape == (1,)  # observation [O] -> control [U], in NumPy

# export
path = pg.export(run, format="numpy", out="balance.py")

# RunError
try:
    pg.controller("runs/elsewhere")
except pg.RunError as error:
    print(error)
