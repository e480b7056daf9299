"""Three vehicles, each a process of its own, that talk UDP on the loopback address and lose messages.

    python -m tests.data.udp [LINK] [STEPS]

Every vehicle steps, sends the other two one datagram each and waits for theirs.  A datagram is the step, and the message
unless it is lost: that is drawn by the sender.  Should the operating system lose one, a vehicle goes on after a while.
"""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import time

import numpy as np

import stochfuse as sf

AGENTS, HEAD, PATIENCE = 3, struct.Struct("<I"), 2.0


def scenario(steps=3):
    """A target on a line, its speed unknown; steps do not matter to a live agent."""
    return sf.load_scenario({
        "model": {"F": [[1, 1], [0, 1]], "Q": [[0.1, 0.1], [0.1, 0.2]], "H": [[1, 0]], "R": 4},
        "initial": {"P": [[10, 0], [0, 2]]},
        "network": {"agents": AGENTS, "steps": steps},
    })  # fmt: skip


def vehicle(number, ports, link, steps):
    """The loop of one vehicle; what it found."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        radio.bind(("127.0.0.1", ports[number]))
        radio.settimeout(PATIENCE)
        print("ready", flush=True)
        sys.stdin.readline()
        return live(number, ports, link, steps, radio)


def live(number, ports, link, steps, radio):
    s = scenario()
    agent = sf.Agent(s, number + 1)
    world, own = np.random.default_rng(1), np.random.default_rng([2, number])
    truth, found, waiting = np.zeros(2), [], {}
    begun = time.process_time()
    for step in range(1, steps + 1):
        if step > 1:
            truth = s.model.F @ truth + world.multivariate_normal(np.zeros(2), s.model.Q)
            agent.step(truth[0] + 2.0 * own.normal())
        message, sent = agent.message(), 0
        for other, port in enumerate(ports):
            if other != number:
                arrives = own.random() < link
                radio.sendto(HEAD.pack(step) + (message if arrives else b""), ("127.0.0.1", port))
                sent += arrives
        came = waiting.pop(step, [])
        while len(came) < AGENTS - 1:
            try:
                datagram = radio.recv(65536)
            except TimeoutError:
                break
            (of,) = HEAD.unpack_from(datagram)
            (came if of == step else waiting.setdefault(of, [])).append(datagram[HEAD.size :])
        heard = [m for m in came if m and agent.receive(m)]
        x, P = agent.fuse()
        found.append((len(message), agent.nodes, sum(map(len, heard)), len(heard), P[0, 0], (x[0] - truth[0]) ** 2))
    spent = (time.process_time() - begun) / steps
    names = ("message", "held", "bytes", "heard", "claimed", "square")
    later = np.array(found)[10:]
    return dict(zip(names, later.mean(axis=0).tolist(), strict=True)) | {
        "longest": int(later[:, 0].max()), "most_held": int(later[:, 1].max()), "seconds": spent
    }  # fmt: skip


def together(link=0.5, steps=200):
    """Start three vehicles; what each found."""
    probes = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(AGENTS)]
    for probe in probes:
        probe.bind(("127.0.0.1", 0))
    ports = [probe.getsockname()[1] for probe in probes]
    for probe in probes:
        probe.close()
    asked = [json.dumps([number, ports, link, steps]) for number in range(AGENTS)]
    command = [sys.executable, "-m", "tests.data.udp", "vehicle"]
    pipe = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([*command, each], **pipe) for each in asked]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:  # all of them listen
        process.stdin.write("go\n")
        process.stdin.flush()
    return [json.loads(process.communicate()[0]) for process in processes]


if __name__ == "__main__":
    if sys.argv[1:2] == ["vehicle"]:
        print(json.dumps(vehicle(*json.loads(sys.argv[2]))))
    else:
        for found in together(*map(float, sys.argv[1:2]), *map(int, sys.argv[2:3])):
            print(", ".join(f"{name} {value:.4g}" for name, value in found.items()))
