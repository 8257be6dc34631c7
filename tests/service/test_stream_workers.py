"""Workers that are killed while clients stream: the clients go on elsewhere with their state, and miss nothing."""

from __future__ import annotations

import os
import signal
from contextlib import ExitStack

import numpy as np
from live_service import live_service, wait_until

from service.clients.stream import StreamClient
from service.engine import GarmentEngine


def test_kill_9_of_every_worker_loses_no_frame(avatars, bundle, motion):
    engine = GarmentEngine(bundle.garment("tshirt"))
    arrays = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    whole, _ = engine.run(*arrays, engine.initial_state())
    with live_service(avatars, "--workers", "2") as service, ExitStack() as stack:
        wait_until(lambda: service.count("ready") == 2)
        first = service.workers()
        assert len(first) == 2
        streams = [stack.enter_context(StreamClient(service.url, "shell", ["tshirt"], patience=60)) for _ in range(4)]
        for frame in range(24):
            if frame in (8, 16):
                os.kill(first[frame // 8 - 1], signal.SIGKILL)
            for stream in streams:
                stream.send(motion.poses[frame], motion.transl[frame])
            for stream in streams:
                answer = stream.receive(timeout=60)
                assert answer.number == frame + 1
                np.testing.assert_allclose(answer.meshes.vertices["tshirt"][-1], whole[frame], rtol=0, atol=5e-6)
        assert all(stream.reconnections >= 1 for stream in streams)
