"""Engines that run independent tasks: a pool of processes on this machine, or Ray on many."""
