"""PyTorch and onnxruntime doing what `radome bench train` and `radome bench infer` do, on as many threads.

    python3 cli/bench/networks.py train [--threads 2] [--batch 32] [--repeats 7] [--turns] [NETWORK...]
    python3 cli/bench/networks.py infer [--threads 2] [--onnx DIR] [--repeats 30] [--turns] [NETWORK...]

Prints a JSON object a line: model, peer, batch, threads, milliseconds (of each repeat, behind one that does not count), a line a
network. With --turns each network is prepared, says so by an empty line, and is then run again for each line of standard input:
so programs take turns. DIR holds what `radome model export` wrote, NETWORK.onnx. Needs torch, torchvision and, for --onnx, onnxruntime
and numpy; `radome bench` calls it where they are.
"""

import argparse
import json
import os
import sys
import time

NETWORKS = ["hqnn", "estimator_matched", "doppler_net", "resnet18", "efficientnet_b0"]


def circuit(x, theta):
    """The two-qubit circuit in closed form, differentiated by autograd: [<ZI>, <IZ>]."""
    import math

    import torch

    x0, x1 = x[:, 0], x[:, 1]
    w = 2 * (math.pi - x0) * (math.pi - x1)
    a, b = torch.sin(2 * x1) * torch.sin(w), torch.sin(2 * x0) * torch.sin(w)
    c = torch.cos(2 * x0) * torch.cos(2 * x1)
    d, e = torch.cos(2 * x1) * torch.cos(w), torch.cos(2 * x0) * torch.cos(w)
    (s0, s1, s2, s3), (c0, c1, c2, c3) = torch.sin(theta), torch.cos(theta)
    zi = c3 * (c0 * s1 * a + s0 * c1 * b + s0 * s1 * c) - s3 * c1 * d
    iz = -c2 * s0 * e - s2 * (c0 * c1 * c - c0 * s1 * b - s0 * c1 * a)
    return torch.stack([zi, iz], 1)


def build(name):
    """The network as models/src/network/ has it."""
    import math

    import torch
    from torch import nn

    class Hqnn(nn.Module):
        def __init__(self, quantum):
            super().__init__()
            self.backbone = nn.Sequential(
                nn.Conv2d(1, 16, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2),
                nn.Conv2d(16, 32, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2),
                nn.AdaptiveAvgPool2d((2, 15)), nn.Flatten(),
                nn.Linear(960, 64), nn.ReLU(), nn.Linear(64, 2),
            )
            self.theta = nn.Parameter(torch.rand(4)) if quantum else None
            self.head = nn.Linear(2, 3)

        def forward(self, x):
            z = self.backbone(x)
            if self.theta is not None:
                z = circuit(math.pi * torch.sigmoid(z), self.theta)
            return self.head(z)

    def doppler_net():
        layers, inputs = [], 1
        for outputs in (16, 32, 64, 128, 256):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU(), nn.MaxPool2d(2)]
            inputs = outputs
        layers += [nn.Flatten(), nn.Linear(4096, 512), nn.BatchNorm1d(512), nn.ReLU(), nn.Dropout(0.5)]
        layers += [nn.Linear(512, 128), nn.BatchNorm1d(128), nn.ReLU(), nn.Dropout(0.5), nn.Linear(128, 3)]
        return nn.Sequential(*layers)

    if name in ("hqnn", "estimator_matched"):
        return Hqnn(name == "hqnn")
    if name == "doppler_net":
        return doppler_net()
    import torchvision

    network = getattr(torchvision.models, name)(num_classes=3)
    if name == "resnet18":
        network.conv1 = nn.Conv2d(1, 64, 7, 2, 3, bias=False)
    else:
        network.features[0][0] = nn.Conv2d(1, 32, 3, 2, 1, bias=False)
    return network


def times(repeats, run):
    run()
    milliseconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        milliseconds.append(1e3 * (time.perf_counter() - began))
    return milliseconds


def rows(arguments, model, peer, batch, run):
    def turn():
        row = {"model": model, "peer": peer, "batch": batch, "threads": arguments.threads}
        print(json.dumps(row | {"milliseconds": times(arguments.repeats, run)}), flush=True)

    if not arguments.turns:
        return turn()
    print(flush=True)
    for _ in sys.stdin:
        turn()


def train(arguments):
    import torch

    torch.set_num_threads(arguments.threads)
    for name in arguments.networks:
        torch.manual_seed(1)
        network = build(name).train()
        adam = torch.optim.Adam(network.parameters(), 1e-3)
        loss = torch.nn.CrossEntropyLoss(weight=torch.ones(3))
        maps, labels = torch.randn(arguments.batch, 1, 128, 128), torch.arange(arguments.batch) % 3

        def step():
            adam.zero_grad()
            loss(network(maps), labels).backward()
            adam.step()

        rows(arguments, name, "pytorch", arguments.batch, step)


def infer(arguments):
    if arguments.onnx:
        import numpy
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = arguments.threads
        for name in arguments.networks:
            path = os.path.join(arguments.onnx, name + ".onnx")
            session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
            of = session.get_inputs()[0]
            shape = [size if isinstance(size, int) else arguments.batch for size in of.shape]
            maps = numpy.random.default_rng(1).standard_normal(shape, numpy.float32)
            rows(arguments, name, "onnxruntime", shape[0], lambda: session.run(None, {of.name: maps}))
        return
    import torch

    torch.set_num_threads(arguments.threads)
    for name in arguments.networks:
        network, maps = build(name).eval(), torch.randn(arguments.batch, 1, 128, 128)
        with torch.inference_mode():
            rows(arguments, name, "pytorch", arguments.batch, lambda: network(maps))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["train", "infer"])
    parser.add_argument("networks", nargs="*", metavar="NETWORK")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch", type=int)
    parser.add_argument("--repeats", type=int)
    parser.add_argument("--onnx", metavar="DIR")
    parser.add_argument("--turns", action="store_true")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.networks if name not in NETWORKS]
    if unknown:
        sys.exit(f"no network {', '.join(unknown)}; there are {', '.join(NETWORKS)}")
    arguments.networks = arguments.networks or NETWORKS
    training = arguments.what == "train"
    arguments.batch = arguments.batch or (32 if training else 1)
    arguments.repeats = arguments.repeats or (7 if training else 30)
    (train if training else infer)(arguments)


main()
