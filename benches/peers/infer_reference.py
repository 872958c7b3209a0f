#!/usr/bin/env python3
"""Times each stage of the reference implementation on the CPU, one line of JSON per stage.

    python3 benches/peers/infer_reference.py SAT3DGEN_CHECKOUT CHECKPOINT IMAGE [--threads 2] [--rounds 3]
        [--precision fp32|fp32-last|bf16|bf16-last] [--dsm-only]

`bf16` has 16-bit weights and maps, `-last` puts channels last; the DSM is always rendered in 32 bits.

The checkout is https://github.com/qianmingduowan/Sat3DGen; it moves tensors to a GPU by `.cuda()`, which
is made to do nothing here. Needs torch, transformers 4.57, diffusers, einops, easydict, scipy, pillow, tqdm.
"""
import argparse
import contextlib
import io
import json
import os
import resource
import statistics
import sys
import time

parser = argparse.ArgumentParser()
parser.add_argument("checkout")
parser.add_argument("checkpoint")
parser.add_argument("image")
parser.add_argument("--threads", type=int, default=2)
parser.add_argument("--rounds", type=int, default=3)
parser.add_argument("--precision", default="fp32", choices=["fp32", "fp32-last", "bf16", "bf16-last"])
parser.add_argument("--dsm-only", action="store_true", help="encoder, decoder and DSM, nothing else")
arguments = parser.parse_args()
os.environ.setdefault("HF_HUB_OFFLINE", "1")
sys.path.insert(0, arguments.checkout)

import numpy as np  # noqa: E402
import torch  # noqa: E402
from PIL import Image  # noqa: E402

torch.set_num_threads(arguments.threads)
torch.Tensor.cuda = lambda self, *a, **k: self
with contextlib.redirect_stdout(io.StringIO()):
    from source.generator import Sat3DGen
    from source.rendering.transform_perspective import (
        fov_size2intrinsics,
        from_Euler_and_position_to_c2w,
    )
    from source.rendering.utils import create_voxel

    Sat3DGen._skip_backbone_weights = True
    model = Sat3DGen.from_pretrained(arguments.checkpoint).eval()

picture = Image.open(arguments.image).convert("RGB").resize((256, 256), Image.BICUBIC)
pixels = torch.from_numpy(np.asarray(picture)).permute(2, 0, 1)[None].float() / 255
mean = torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1)
deviation = torch.tensor([0.229, 0.224, 0.225]).view(1, 3, 1, 1)
image = (pixels - mean) / deviation
histogram = torch.full((1, 270), 1.0 / 90.0)
unet = model.unet_model
kind = torch.bfloat16 if arguments.precision.startswith("bf16") else torch.float32
order = torch.channels_last if arguments.precision.endswith("last") else torch.contiguous_format
unet.to(dtype=kind, memory_format=order)
image = image.to(kind)


def tokens():
    output = unet.dino_model(image, output_hidden_states=True).last_hidden_state
    grid = output[:, 1 + unet.num_register_tokens :].reshape(1, 16, 16, -1).permute(0, 3, 1, 2)
    side = int(16 * unet.pad)
    return torch.nn.functional.pad(grid, (side, side, side, side))


def planes(features):
    # As `from_sat_to_triplane` splits the decoder's output.
    output = unet.decoder(features.contiguous(memory_format=order)).float()
    dim = model.opt.network.triplane.dim
    return [output[:, None, :dim], output[:, dim:].mean(dim=2)]


def view(field, sky, **wanted):
    position = np.array([-0.3, -0.25, -0.85])
    c2w = from_Euler_and_position_to_c2w([0, 10, 35], position)
    c2w = model.c2w_prepare(torch.from_numpy(c2w).float()[None])
    intrinsics = torch.from_numpy(fov_size2intrinsics(120, [256, 256])).float()[None]
    intrinsics[:, :2] /= 2
    return model.from_3D_to_results(
        field, c2w, w_sky=sky[0], sky_feature_2D=sky[1], intrinsics=intrinsics, **wanted
    )


def ortho(field):
    sampler = model.point_sampler_sat(batch_size=1, random_crop=False, crop_type="crop")
    return model.from_point_sampling2result(sampler, field, w_sky=torch.zeros(1, model.w_dim))


def grid(field, count=320, batch=1_000_000):
    # As `forward_grid`, whose own batch of 15 million points takes 12 GB and more.
    points = create_voxel(N=count, position_scale_factor=1)["voxel_grid"]
    parts = [
        model.density_reg(coordinates=points[:, k : k + batch], triplane_ori=field)
        for k in range(0, points.shape[1], batch)
    ]
    return torch.cat(parts, 1)


def timed(name, run):
    seconds = []
    for _ in range(arguments.rounds):
        start = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - start)
    print(json.dumps({"stage": name, "seconds": statistics.median(seconds), "all": seconds}), flush=True)
    return result


def sky():
    code = model.w_sky_prepare(histogram)
    return code, model.w_sky2sky_feature_2D(code, histogram)


with torch.no_grad():
    features = timed("encoder", tokens)
    field = timed("decoder", lambda: planes(features))
    timed("dsm", lambda: ortho(field))
    light = None if arguments.dsm_only else timed("sky", sky)
    for name, output, wanted in (
        ("panorama", "str_output", {"syn_pano": True}),
        ("perspective", "per_output", {"syn_pano": False, "syn_per": True}),
    ):
        if arguments.dsm_only:
            break
        result = timed(name, lambda: view(field, light, **wanted))
        composite = result[output].image_raw_compo
        timed(f"{name}, super-resolution only", lambda: model.sr_module(composite))
    if not arguments.dsm_only:
        timed("grid 320", lambda: grid(field))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 / 1024
print(json.dumps({"stage": "peak memory", "gib": peak}))
