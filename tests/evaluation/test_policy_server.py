"""One policy for all workers: batches, refusals, failures, rows that depend on their company."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from fluxvla_core.errors import CheckpointError, ConfigError, RunFailed, SpecMismatch
from fluxvla_core.evaluation.policy_server import PolicyServer, ServedPolicy, check_rows
from fluxvla_core.policies.local import Query
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

pytest.importorskip("torch")

ARM = EmbodimentSpec("arm", (Joint("a", "rad", -1, 1, 1, 1),), (Camera("eye", 4, 5),), 10.0)


class Batched:
    """What the server uses of a local policy; answers tell seed, call and what was seen."""

    embodiment, cameras, action_rate_hz, horizon = ARM, ("eye",), 10.0, 2
    device, continues, n_obs_steps = "cpu", True, 1

    def __init__(self, batch_size=3, leaks=False):
        self.batch_size, self.leaks, self.sizes, self.started = batch_size, leaks, [], None

    def predict_batch(self, queries):
        self.sizes.append(len(queries))
        if self.started is not None:
            self.started.set()
            self.go.wait(30)
        for query in queries:
            match query.observation["task_description"]:
                case "crowd" if len(queries) > 1:
                    raise MemoryError("too many at once")
                case "raise":
                    raise ZeroDivisionError("weights exploded")
                case "refuse":
                    raise SpecMismatch("nobody can do that")
                case "fail":
                    raise RunFailed("out of memory")
        total = sum(float(q.observation["qpos"][0]) for q in queries) if self.leaks else 0.0
        return [
            np.array([[q.seed, q.call, q.observation["qpos"][0] + total, q.rest is not None]] * 2)
            for q in queries
        ]


def see(value=0.0, words="go"):
    return {"qpos": np.array([value]), "images": {}, "task_description": words}


@pytest.fixture
def policy():
    return Batched()


@pytest.fixture
def server(policy):
    with PolicyServer({"policy": lambda: policy}) as made:
        yield made


def client(server):
    return ServedPolicy(server.link(), "policy", server.facts["policy"])


def test_answers_follow_from_the_seed_and_the_number_of_the_call(server):
    one, two = client(server), client(server)
    one.reset(5)
    two.reset(6)
    assert one.predict_action(see(0.5))[0].tolist() == [5, 0, 0.5, 0]
    assert two.predict_action(see())[0].tolist() == [6, 0, 0, 0]
    assert one.predict_action(see())[0].tolist() == [5, 1, 0, 0]
    assert one.continue_action(see(), "the rest")[0].tolist() == [5, 2, 0, 1]
    one.reset(7)
    assert one.predict_action(see())[0].tolist() == [7, 0, 0, 0]
    assert (one.embodiment, one.cameras, one.horizon, one.continues) == (ARM, ("eye",), 2, True)


def test_what_waits_while_the_policy_thinks_is_the_next_batch(server, policy):
    clients = [client(server) for _ in range(5)]
    policy.sizes.clear()
    policy.started, policy.go = threading.Event(), threading.Event()
    answers = {}

    def ask(number):
        clients[number].reset(number)
        answers[number] = clients[number].predict_action(see())[0][0]

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(5)]
    threads[0].start()
    assert policy.started.wait(30)
    for thread in threads[1:]:
        thread.start()
    policy.go.set()
    for thread in threads:
        thread.join(30)
    assert answers == {n: n for n in range(5)}
    assert policy.sizes[0] == 1, "nobody waits for company"
    assert sum(policy.sizes) == 5
    assert max(policy.sizes) <= 3
    assert (server.batches, server.rows) == (len(policy.sizes), 5)


def test_a_failing_policy_fails_those_who_asked_and_no_one_else(server):
    one = client(server)
    with pytest.raises(RunFailed, match=r"the policy raised:\n(.|\n)*weights exploded"):
        one.predict_action(see(words="raise"))
    with pytest.raises(RunFailed, match="out of memory"):
        one.predict_action(see(words="fail"))
    with pytest.raises(SpecMismatch, match="nobody can do that"):
        one.predict_action(see(words="refuse"))
    assert client(server).predict_action(see()).shape == (2, 4)


@pytest.mark.parametrize(
    ("words", "kind", "text"),
    [
        ("raise", "raised", "weights exploded"),
        ("fail", "raised", "out of memory"),
        ("refuse", "refused", "nobody can do that"),
        ("crowd", "chunk", "0.5"),
    ],
)
def test_one_that_cannot_be_answered_is_no_error_of_its_company(server, policy, words, kind, text):
    connections = [server.link() for _ in range(4)]
    for connection in connections:  # once they are answered the server knows them all
        connection.send(("policy", Query(see(), 0, 0)))
        connection.recv()
    policy.sizes.clear()
    server.batches = server.rows = 0
    policy.started, policy.go = threading.Event(), threading.Event()
    for number, asked in enumerate(("go", "go", words, "go")):
        connections[number].send(("policy", Query(see(0.5, asked), number, 0)))
        assert policy.started.wait(30), "the first is asked alone, while the others wait"
    policy.go.set()
    answers = [connection.recv() for connection in connections]
    assert policy.sizes == [1, 3, 1, 1, 1]
    for number in (0, 1, 3):
        assert answers[number][0] == "chunk"
        assert answers[number][1].tolist() == [[number, 0, 0.5, 0]] * 2
    assert answers[2][0] == kind
    assert text in str(answers[2][1])
    assert (server.batches, server.rows) == (5, 4)


def test_a_worker_that_is_gone_takes_nobody_with_it(server):
    one = client(server)
    one._connection.send(("policy", Query(see(), 0, 0)))
    one._connection.close()
    assert client(server).predict_action(see()).shape == (2, 4)


def test_a_server_that_is_gone_is_told(policy):
    with PolicyServer({"policy": lambda: policy}) as server:
        one = client(server)
        assert one.predict_action(see()).shape == (2, 4)
    server.close()
    with pytest.raises(RunFailed, match="the process with the policy is gone"):
        one.predict_action(see())
    with pytest.raises(RunFailed, match="the thread with the policy has ended"):
        server.link()


def test_a_policy_that_cannot_be_loaded_is_refused_where_the_server_is_made():
    def missing():
        raise CheckpointError("there is no checkpoint")

    with pytest.raises(CheckpointError, match="there is no checkpoint"):
        PolicyServer({"policy": missing})


def test_rows_that_depend_on_their_company_are_refused():
    check_rows(Batched())
    check_rows(Batched(1, leaks=True))
    with pytest.raises(ConfigError, match="batch_size = 3: on cpu a row's result depends on") as e:
        PolicyServer({"policy": lambda: Batched(leaks=True)})
    assert "--set <section>.batch_size=1, or another size" in str(e.value)
