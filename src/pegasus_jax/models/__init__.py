"""Models of the dynamics from data: each module makes values of `types.Dynamics`, or a part of one."""
