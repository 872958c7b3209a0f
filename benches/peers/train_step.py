#!/usr/bin/env python3
"""A few training steps of the reference implementation on the CPU, one line of JSON each, beside ours.

    python3 benches/peers/train_step.py make FOLDER
    python3 benches/peers/train_step.py run SAT3DGEN_CHECKOUT CHECKPOINT FOLDER STEPS [--threads 2]
    python3 benches/peers/train_step.py compare FOLDER

`make` draws the pictures of a batch of two. `run` needs what `examples/train_step.rs` has put into FOLDER; the
checkout is https://github.com/qianmingduowan/Sat3DGen. Its networks are made as small as the parity data's, its
random numbers are replaced (samples in the middle of their shares, no window, one direction), and absolute
errors stand in for LPIPS; sampling, rendering, losses and discriminators are its own. Needs torch, transformers
4.57, diffusers, einops, easydict, scipy, opencv, pillow, tqdm.
"""
import argparse
import ast
import contextlib
import io
import json
import os
import resource
import sys
import time

parser = argparse.ArgumentParser()
commands = parser.add_subparsers(dest="command", required=True)
commands.add_parser("make").add_argument("folder")
running = commands.add_parser("run")
running.add_argument("checkout")
running.add_argument("checkpoint")
running.add_argument("folder")
running.add_argument("steps", type=int)
running.add_argument("--threads", type=int, default=2)
commands.add_parser("compare").add_argument("folder")
arguments = parser.parse_args()


def make(folder):
    import numpy as np
    from PIL import Image

    os.makedirs(folder, exist_ok=True)
    draw = np.random.default_rng(7)

    def smooth(height, width, channels):
        y, x = np.mgrid[0:height, 0:width]
        total = np.zeros((height, width, channels))
        for _ in range(6):
            down, right = draw.integers(1, 5, 2)
            phase = draw.uniform(0, 2 * np.pi, channels)
            wave = 2 * np.pi * (down * y / height + right * x / width)
            total += draw.uniform(0.3, 1, channels) * np.sin(wave[..., None] + phase)
        return np.clip(127.5 + 30 * total, 0, 255).astype(np.uint8)

    for index in range(2):
        sky = np.zeros((256, 512), np.uint8)
        horizon = 100 + 20 * np.sin(np.arange(512) / 512 * 2 * np.pi * (index + 2))
        sky[np.arange(256)[:, None] < horizon[None]] = 255
        for name, picture in (
            ("satellite", smooth(320, 320, 3)),
            ("panorama", smooth(256, 512, 3)),
            ("sky", sky),
            ("depth", smooth(128, 128, 1)[..., 0]),
        ):
            Image.fromarray(picture).save(f"{folder}/{name}.{index}.png")


def tiny(module, config):
    """Makes the reference's classes build networks of the sizes that the config names."""
    from torch import nn
    from transformers import AutoConfig, AutoModel

    network, backbone = config["opt"]["network"], config["opt"]["backbone_config"]
    names = ("Decoder", "MappingNetwork", "MLPNetwork2", "SuperresolutionHybrid2X")
    if not hasattr(module, "large"):
        module.large = [getattr(module, name) for name in names]
    decoder, mapping, head, sharp = module.large

    def small_decoder(**given):
        if given.get("pano_pad"):
            multipliers = network["sky_decoder_ch_mult"]
            given.update(ch=network["sky_decoder_ch"], ch_mult=multipliers, z_channels=network["w_dim"])
        else:
            given.update(ch=network["decoder_ch"], z_channels=backbone["hidden_size"])
        return decoder(**given)

    def small_sharp(inputs, outputs, padding_mode, v2):
        built, width = sharp(inputs, outputs, padding_mode=padding_mode, v2=v2), network["sr_channels"]
        built.block0.skip_conv = nn.Conv2d(inputs, width, 1)
        built.block1.toRGB = nn.Conv2d(width, outputs, 1, bias=False)
        for block, first in ((built.block0, inputs), (built.block1, width)):
            for convolution, channels in ((block.conv0, first), (block.conv1, width)):
                convolution.conv = nn.Conv2d(channels, width, 3, 1, 1, padding_mode=padding_mode)
        return built

    def small_backbone(name, skip_weights=False):
        with module.no_init_weights():
            built = AutoModel.from_config(AutoConfig.for_model(**dict(backbone)))
        return built.eval().requires_grad_(False)

    module.load_backbone_model = small_backbone
    module.Decoder = small_decoder
    module.MappingNetwork = lambda inputs, outputs, norm: mapping(
        inputs, network["w_dim"], num_layers=network["sky_mapping_layers"], norm=norm
    )
    module.MLPNetwork2 = lambda input_dim, hidden_dim, output_dim, style_dim: head(
        input_dim, network["mlp_hidden_dim"], output_dim, network["w_dim"]
    )
    module.SuperresolutionHybrid2X = small_sharp


def load(module, folder):
    """The reference's own loading of a checkpoint folder; its backbone has to have a name that it knows."""
    import tempfile

    with open(f"{folder}/config.json") as file:
        config = json.load(file)
    tiny(module, config)
    config["opt"]["backbone"] = "dinov3-large-sat"
    with tempfile.TemporaryDirectory() as place, contextlib.redirect_stdout(io.StringIO()):
        with open(f"{place}/config.json", "w") as file:
            json.dump(config, file)
        weights = "diffusion_pytorch_model.safetensors"
        os.symlink(os.path.abspath(f"{folder}/{weights}"), f"{place}/{weights}")
        model, report = module.Sat3DGen.from_pretrained(place, output_loading_info=True)
    model.w_dim = config["opt"]["network"]["w_dim"]
    model.unet_model.dino_model.requires_grad_(False)
    return model, report


def run(checkout, checkpoint, folder, steps, threads):
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    sys.path.insert(0, checkout)
    import numpy as np
    import torch
    import torch.nn.functional as F
    from PIL import Image
    from safetensors.torch import load_file

    torch.set_num_threads(threads)
    torch.Tensor.cuda = lambda self, *a, **k: self
    with contextlib.redirect_stdout(io.StringIO()):
        import source.generator as module
        from source.discriminators import Discriminator
        from source.losses.density_tv_loss import compute_density_tv_loss
        from source.losses.depth_loss import MidasLoss
        from source.losses.sat_depth_loss import compute_depth_loss
        from source.rendering.pano2perspective import GetPerspective
        from source.rendering.sat2density_transform_eg3d import (
            Point_sampler_ortho,
            Point_sampler_pano,
            get_original_coord,
        )
        from source.rendering.transform_perspective import (
            PointSamplerPerspective,
            from_Euler_and_position_to_c2w,
        )
        from source.sky_histogram import compute_sky_histogram
    # Three functions of the training script, which as a whole needs much more to be imported.
    with open(f"{checkout}/train.py") as file:
        wanted = ("gradient_penalty", "mask_l1_loss", "Custom_non_sky_MeanLoss")
        body = [part for part in ast.parse(file.read()).body if getattr(part, "name", "") in wanted]
    script = {"torch": torch, "F": F, "np": np}
    exec(compile(ast.Module(body, []), "train.py", "exec"), script)

    # Samples in the middle of their shares.
    torch.rand_like = lambda like, **_: torch.full_like(like, 0.5)

    def middles(*shape, device=None, **_):
        return ((torch.arange(shape[-1]) + 0.5) / shape[-1]).expand(*shape).clone()

    torch.rand = middles

    model, report = load(module, checkpoint)
    samples = 24
    model.num_importance = samples
    directions = get_original_coord(W=64, H=16, full=True).unsqueeze(0).float()
    model.point_sampler = Point_sampler_pano(
        pano_direction=directions, num_points=samples, aabb_strict=True, data_type="vigor"
    )
    model.point_sampler_per = PointSamplerPerspective(
        num_points=samples, aabb_strict=True, render_size=[32, 32]
    )
    model.point_sampler_sat = Point_sampler_ortho(
        num_points=samples,
        position_scale_factor=model.position_scale_factor,
        resolution=64,
        render_size=64,
    )
    # Without the random coordinates of the encoder; nothing else depends on the mode.
    model.eval()

    start = load_file(f"{folder}/start.safetensors")
    critics = {}
    for view in ("satellite", "panorama", "perspective"):
        with contextlib.redirect_stdout(io.StringIO()):
            critic = Discriminator(img_resolution=64, in_channels=3)
        state = {}
        places = [0, 2, 5, 8]
        for layer, place in enumerate(places):
            parameters = f"discriminators/{view}.encoder.{layer}."
            vectors = f"power-iterations/{view}.encoder.{layer}."
            state[f"encoder.{place}.weight_orig"] = start[parameters + "weight"]
            state[f"encoder.{place}.bias"] = start[parameters + "bias"]
            state[f"encoder.{place}.weight_u"] = start[vectors + "u"]
            state[f"encoder.{place}.weight_v"] = start[vectors + "v"]
        for name in ("weight", "bias"):
            state[f"shuffle.{name}"] = start[f"discriminators/{view}.shuffle.{name}"]
        missing, unexpected = critic.load_state_dict(state, strict=False)
        assert not unexpected and all("weight" in key for key in missing), (missing, unexpected)
        critics[view] = critic

    def adamw(parameters):
        return torch.optim.AdamW(
            parameters, lr=1e-4, betas=(0.0, 0.9), weight_decay=0.01, eps=1e-8
        )

    optimiser = adamw([p for p in model.parameters() if p.requires_grad])
    critic_optimiser = adamw([p for critic in critics.values() for p in critic.parameters()])

    # The pictures, as the reference's data set makes them.
    def signed(picture):
        array = np.array(picture)
        return torch.from_numpy(array.transpose(2, 0, 1)).float().div(255).mul(2).add(-1)

    batch = {name: [] for name in ("input", "satellite", "panorama", "sky", "histogram", "depth", "perspective")}
    mean = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)
    deviation = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
    side, fov, yaw = 64, 105.0, 35.0
    focal, centre = 0.5 * side / np.tan(0.5 * fov / 180 * np.pi), (side - 1) / 2
    for index in range(2):
        picture = {n: Image.open(f"{folder}/{n}.{index}.png") for n in ("satellite", "panorama", "sky", "depth")}
        image = picture["satellite"].resize((256, 256), Image.BICUBIC)
        batch["input"].append(((signed(image) + 1) / 2 - mean) / deviation)
        batch["satellite"].append(signed(picture["satellite"].resize((64, 64))))
        batch["panorama"].append(signed(picture["panorama"].resize((128, 32))))
        mask = picture["sky"].resize((128, 32), Image.NEAREST)
        batch["sky"].append(torch.from_numpy(np.array(mask)).float().div(255).unsqueeze(0))
        wide = signed(picture["panorama"].resize((512, 128)))
        mask = picture["sky"].resize((512, 128), Image.NEAREST)
        mask = torch.from_numpy(np.array(mask)).float().div(255).unsqueeze(0)
        seen = (wide.add(1).mul(0.5) * mask).mul(2).add(-1).float()
        batch["histogram"].append(torch.from_numpy(compute_sky_histogram(seen.numpy())).float())
        depth = picture["depth"].convert("RGB").resize((64, 64)).convert("L")
        batch["depth"].append(torch.from_numpy(np.array(depth)).float().div(255).unsqueeze(0))
        cut = GetPerspective(
            [np.array(picture["panorama"])], [focal, focal, centre, centre], yaw, 0.0, side, side
        )
        batch["perspective"].append(signed(cut))
    batch = {name: torch.stack(parts) for name, parts in batch.items()}
    intrinsics = torch.tensor(
        [[focal / 2, 0, centre / 2], [0, focal / 2, centre / 2], [0, 0, 1]]
    ).float()
    intrinsics = intrinsics.expand(2, 3, 3)
    # Crop position (row, column, z) of the example.
    row, column, z = 0.2, -0.15, -0.85
    pose = from_Euler_and_position_to_c2w([0, 0.0, yaw], np.array([column, -row, z]))
    pose = torch.from_numpy(pose).float()[None].repeat(2, 1, 1)

    def half(picture):
        return F.interpolate(picture, scale_factor=0.5, mode="bilinear", antialias=True)

    midas = MidasLoss(alpha=2)
    fakes = {}
    print(json.dumps({"loaded": {name: len(keys) for name, keys in report.items()}}), flush=True)
    for step in range(steps):
        begin = time.perf_counter()
        terms = {}
        if step % 2 == 0:
            for critic in critics.values():
                critic.requires_grad_(False).eval()
            points = torch.cat([start[f"points/{step}/{name}"] for name in ("lower", "upper")], 1)
            output = model(
                batch["input"],
                z_ill=batch["histogram"],
                syn_sat=True,
                random_sat_crop=False,
                syn_pano=True,
                syn_per=True,
                intrinsics=intrinsics.clone(),
                c2w=pose.clone(),
                coordinates=points,
            )
            above, around, ahead = output.sat_output, output.str_output, output.per_output
            rgb = above.feature_raw[:, :3].mul(2).add(-1)
            terms["satellite"] = 2 * F.l1_loss(rgb, batch["satellite"])
            opacity = F.binary_cross_entropy_with_logits
            terms["ortho_opacity"] = 30 * 0.1 * opacity(above.alpha_raw, torch.ones_like(above.alpha_raw))
            terms["depth"] = 0.1 * compute_depth_loss(midas, above.image_depth, batch["depth"])
            fakes = {"satellite": rgb}
            for name, view, weight in (("panorama", around, 3.0), ("perspective", ahead, 1.5)):
                sharp = view.sr_image.mul(2).add(-1)
                raw = view.image_raw_compo[:, :3].mul(2).add(-1)
                terms[name] = weight * F.l1_loss(sharp, batch[name])
                terms[f"{name}.raw"] = weight * 0.1 * 0.618 * F.l1_loss(raw, half(sharp))
                fakes[name] = sharp
            solid = F.interpolate(1 - batch["sky"], scale_factor=0.5, mode="nearest")
            terms["opacity"] = 30 * opacity(around.alpha_raw, solid)
            sky = around.sky_img[:, :3]
            terms["sky_colour"] = script["mask_l1_loss"](sky.mul(2).add(-1), half(batch["panorama"]), 1 - solid)
            terms["mean_sky_colour"] = 0.1 * script["Custom_non_sky_MeanLoss"](
                sky, half(batch["panorama"].mul(0.5).add(0.5)), 1 - solid
            )
            for name, picture in fakes.items():
                terms[f"adversarial.{name}"] = 0.2 * F.softplus(-critics[name](picture)).mean()
            terms["gravity"] = 3.5 * compute_density_tv_loss(output.density, 1.0)
            total = sum(terms.values())
            total.backward()
            optimiser.step()
            optimiser.zero_grad()
            fakes = {name: picture.detach() for name, picture in fakes.items()}
        else:
            for name, critic in critics.items():
                critic.requires_grad_(True).train()
                picture = batch[name].clone().requires_grad_()
                real, fake = critic(picture), critic(fakes[name])
                term = F.softplus(fake).mean() + F.softplus(-real).mean()
                terms[f"discriminator.{name}"] = term + script["gradient_penalty"](picture, real)
            total = sum(terms.values())
            total.backward()
            critic_optimiser.step()
            critic_optimiser.zero_grad()
        seconds = time.perf_counter() - begin
        values = {"total": total.item(), **{name: term.item() for name, term in terms.items()}}
        print(json.dumps({"step": step, "seconds": seconds, "terms": values}), flush=True)
    print(json.dumps({"gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 / 1024}))

    # What ours has trained, loaded by the reference.
    model, report = load(module, f"{folder}/exported")
    file = load_file(f"{folder}/exported/diffusion_pytorch_model.safetensors")
    state = model.state_dict()
    same = sum(bool(torch.equal(state[name], tensor)) for name, tensor in file.items() if name in state)
    counts = {name: len(keys) for name, keys in report.items()}
    print(json.dumps({"exported": counts, "tensors": len(file), "equal": same}))


def compare(folder):
    import statistics

    def read(name):
        with open(f"{folder}/{name}.jsonl") as file:
            rows = [json.loads(line) for line in file]
        steps = [row for row in rows if "step" in row]
        rest = {key: value for row in rows if "step" not in row for key, value in row.items()}
        return steps, rest

    (ours, about), (theirs, reference) = read("ours"), read("reference")
    print("reference loaded the start:", reference["loaded"])
    print(f"reference loaded our export: {reference['exported']}, {reference['equal']} of {reference['tensors']} tensors equal")
    worst = 0.0
    print(f"{'step':>4} {'term':28} {'reference':>13} {'sat3d':>13} {'relative':>10}")
    for mine, other in zip(ours[:2], theirs[:2]):
        for name, value in other["terms"].items():
            found = mine["terms"][name]
            difference = abs(found - value) / max(abs(value), 1e-9)
            worst = max(worst, difference if mine["step"] == 0 else 0.0)
            print(f"{mine['step']:4} {name:28} {value:13.7f} {found:13.7f} {difference:10.1e}")
    print("totals:")
    for mine, other in zip(ours, theirs):
        a, b = other["terms"]["total"], mine["terms"]["total"]
        print(f"{mine['step']:4} {'':28} {a:13.7f} {b:13.7f} {abs(a - b) / abs(a):10.1e}")
    for turn, name in enumerate(("generator", "discriminators")):
        a, b = (statistics.median(row["seconds"] for row in rows[2 + turn :: 2]) for rows in (theirs, ours))
        print(f"a step of the {name}: reference {a:.2f} s, sat3d {b:.2f} s")
    print(f"most memory: reference {reference['gib']:.2f} GiB, sat3d {about['gib']:.2f} GiB")
    print(f"first step: worst relative difference {worst:.1e}")
    sys.exit(0 if worst < 1e-4 else 1)


if arguments.command == "make":
    make(arguments.folder)
elif arguments.command == "compare":
    compare(arguments.folder)
else:
    run(arguments.checkout, arguments.checkpoint, arguments.folder, arguments.steps, arguments.threads)
