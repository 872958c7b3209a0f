#!/usr/bin/env python3
"""The small network's twin in PyTorch, learning from the same kind of scenes with the same losses: seconds of a
step and the loss curve, one line of JSON per 50 steps, to hold against the log of `sat3d train`.

    python3 benches/peers/train_mini.py SCENES STEPS [--threads 2]

SCENES is a folder of `sat3d simulate --random N --size 256`. Architecture, first weights (in distribution),
losses, optimiser and schedule are those of pipelines/train/mini.toml; the head's colour is left out, which
ours computes beside. Needs torch, numpy, pillow.
"""
import argparse
import glob
import json
import os
import time

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import nn

parser = argparse.ArgumentParser()
parser.add_argument("scenes")
parser.add_argument("steps", type=int)
parser.add_argument("--of", type=int, default=8000, help="steps of the whole schedule")
parser.add_argument("--threads", type=int, default=2)
parser.add_argument("--batch", type=int, default=8)
arguments = parser.parse_args()
torch.set_num_threads(arguments.threads)
torch.set_flush_denormal(True)
torch.manual_seed(0)

MEAN, DEVIATION = np.float32([0.485, 0.456, 0.406]), np.float32([0.229, 0.224, 0.225])
# Ground, street, water, building, tree, as scenes.json numbers them, to ground, building, tree, water.
CLASSES = np.array([0, 0, 3, 1, 2, 0, 0])


def scenes(root):
    """Pictures, heights over the mean ground, ground likewise, classes."""
    for path in sorted(glob.glob(f"{root}/truth/*_dsm.npz")):
        stem = os.path.basename(path)[: -len("_dsm.npz")]
        picture = Image.open(glob.glob(f"{root}/vigor/*/satellite/{stem}.png")[0]).convert("RGB")
        truth = np.load(path)
        ground = truth["dtm"].astype(np.float32)
        surface = truth["dsm"].astype(np.float32) - ground.mean()
        picture = (np.asarray(picture.resize((256, 256), Image.BICUBIC), np.float32) / 255 - MEAN) / DEVIATION
        yield picture, surface, ground - ground.mean(), CLASSES[truth["class"]]


class NormConv(nn.Module):
    def __init__(self, inputs, outputs, side, stride):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, side, stride, side // 2 if stride == 1 else 0, bias=False)
        self.norm = nn.BatchNorm2d(outputs, momentum=0.05)
        nn.init.kaiming_normal_(self.conv.weight, mode="fan_in")

    def forward(self, x):
        return self.norm(self.conv(x))


class Block(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.first, self.second = NormConv(width, width, 3, 1), NormConv(width, width, 3, 1)

    def forward(self, x):
        return F.relu(x + self.second(F.relu(self.first(x))))


class Network(nn.Module):
    def __init__(self, widths=(48, 96, 144), blocks=(1, 1, 3), outputs=20):
        super().__init__()
        a, b, c = widths
        many = lambda width, count: nn.Sequential(*[Block(width) for _ in range(count)])
        self.stem, self.level0 = NormConv(3, a, 4, 4), many(a, blocks[0])
        self.down1, self.level1 = NormConv(a, b, 2, 2), many(b, blocks[1])
        self.down2, self.level2 = NormConv(b, c, 2, 2), many(c, blocks[2])
        self.position = nn.Parameter(torch.zeros(1, c, 16, 16))
        self.up1, self.merge1 = NormConv(c, b, 1, 1), many(b, blocks[1])
        self.up0, self.merge0 = NormConv(b, a, 1, 1), many(a, blocks[0])
        self.plane = nn.Conv2d(a, 4 * outputs, 1)
        nn.init.normal_(self.plane.weight, 0, 0.1 * a**-0.5)
        nn.init.zeros_(self.plane.bias)

    def forward(self, x):
        level0 = self.level0(F.relu(self.stem(x)))
        level1 = self.level1(F.relu(self.down1(level0)))
        deep = self.level2(F.relu(self.down2(level1))) + self.position
        x = self.merge1(F.relu(F.interpolate(self.up1(deep), scale_factor=2) + level1))
        x = self.merge0(F.relu(F.interpolate(self.up0(x), scale_factor=2) + level0))
        return F.pixel_shuffle(self.plane(x), 2)


def symlog(h):
    return torch.sign(h) * torch.log1p(h.abs())


def smooth_l1(difference, knee):
    return F.smooth_l1_loss(difference, torch.zeros_like(difference), beta=knee)


data = list(scenes(arguments.scenes))
network = Network()
optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, betas=(0.9, 0.999), weight_decay=0.01)
draw = np.random.default_rng(0)
mean4 = lambda values: values.reshape(128, 2, 128, 2).mean((1, 3))
spent, terms = 0.0, []
for step in range(arguments.steps):
    chosen = [data[draw.integers(len(data))] for _ in range(arguments.batch)]
    chosen = [[v[:, ::-1] for v in item] if draw.integers(2) else item for item in chosen]
    tensor = lambda arrays: torch.from_numpy(np.ascontiguousarray(np.stack(arrays)))
    x = tensor([item[0].transpose(2, 0, 1) for item in chosen])
    surface = tensor([mean4(item[1]) for item in chosen])
    ground = tensor([mean4(item[2]) for item in chosen])
    classes = tensor([item[3][::2, ::2] for item in chosen])
    begun = time.perf_counter()
    rate = min((step + 1) / 200, 1) * 0.5 * (1 + np.cos(np.pi * step / arguments.of))
    for group in optimiser.param_groups:
        group["lr"] = 2e-3 * rate
    output = network(x)
    height = output[:, 0] * 8
    difference = height - surface
    ramp = 0.1 + 0.9 * min(2 * step / arguments.of, 1)
    parts = {
        "logarithm": smooth_l1(symlog(height) - symlog(surface - ground), 0.2),
        "metric": smooth_l1(difference, 10.0) * 0.5 * ramp,
        "slope": sum(difference.diff(dim=axis).abs().sum() for axis in (1, 2)) / difference.numel() * 0.05,
        "classes": F.cross_entropy(output[:, 16:], classes) * 0.2,
    }
    loss = sum(parts.values())
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    spent += time.perf_counter() - begun
    terms.append([part.item() for part in parts.values()])
    if step % 50 == 49:
        means = dict(zip(parts, np.mean(terms, 0).round(4).tolist()))
        print(json.dumps({"step": step + 1, "seconds_a_step": round(spent / 50, 4), "terms": means}), flush=True)
        spent, terms = 0.0, []
