"""Deterministic simulation of the session protocol: real actors and learners, virtual time, a faulty network.

    kernel.py       virtual time; the learner's threads, which run one at a time, in an order that a seed decides
    process.py      threads that are frozen and killed together, and the callbacks of their transport
    primitives.py   the parts of `threading`, `time` and `queue` that the services use, on the kernel
    network.py      a network whose messages are lost, duplicated, delayed and reordered
    link.py         the Transport of one process
    traffic.py      what passes a link: queries, answers, pushed values, presence
    codec.py        messages that travel as objects, because encoding would take most of the time
    settings.py     what a seed decides: the run, the fleet, the faults
    learners.py     the real actor server, and a loop that takes batches in place of training
    actors.py       the real session engine of an actor, with rollouts that are made without environments
    faults.py       kills, stops, freezes, cuts and restarts of processes
    world.py        all processes, and a supervisor that restarts those that end
    ledger.py       what happened to each rollout, and the invariants
    simulate.py     one simulation from a seed

`python -m tests.simulation --help` runs many seeds.
"""
