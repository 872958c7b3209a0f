#!/usr/bin/env python3
"""Runs the reference implementation's slicing over a picture on the CPU and prints one line of JSON.

    python3 benches/peers/tile_reference.py SAT3DGEN_CHECKOUT CHECKPOINT IMAGE OUT [--stride 64]

The checkout is https://github.com/qianmingduowan/Sat3DGen. Its script `inference/big_image_slice_inference.py` is
run as it is, with three things changed round it:

- `.cuda()` does nothing;
- points are evaluated in portions of `--chunk` (0: all 15 million at a time, as released, which takes 12 GB and more). Each
  point is evaluated by itself, so the values stay;
- a small network (a config with the keys of `crates/sat3d-model/fixtures/tiny`) gets its sizes, which the
  released classes hold as constants. Only what densities need is made of it.

Needs torch, torchvision, transformers 4.57, diffusers, einops, easydict, scikit-image, trimesh, pillow, tqdm.
OUT gets the script's own files `density_volume.npz` (key `density`: row, column, level), `mesh.ply` (voxels) and `crop.png`.
"""
import argparse
import contextlib
import io
import json
import os
import pathlib
import resource
import runpy
import shutil
import sys
import time

WINDOW, PIXEL = 256, 0.28


def arguments():
    parser = argparse.ArgumentParser()
    parser.add_argument("checkout", type=pathlib.Path)
    parser.add_argument("checkpoint", type=pathlib.Path)
    parser.add_argument("image", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--stride", type=int, default=64)
    parser.add_argument("--isovalue", type=float, default=4.5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--chunk", type=int, default=1_000_000)
    return parser.parse_args()


def with_sizes(generator, config):
    """Gives the released classes the sizes of a small config, where they are constants."""
    network = config["network"]
    hidden = config["backbone_config"]["hidden_size"]
    # A known name with another content: the released code asks for the name alone.
    generator._BACKBONE_CONFIGS["dinov3-large-sat"] = config["backbone_config"]
    decoder, head = generator.Decoder, generator.MLPNetwork2

    def sized_decoder(**given):
        if given.get("pano_pad"):
            return generator.nn.Identity()  # the sky's
        return decoder(**{**given, "ch": network["decoder_ch"], "z_channels": hidden})

    def sized_head(**given):
        return head(**{**given, "hidden_dim": network["mlp_hidden_dim"], "style_dim": network["w_dim"]})

    generator.Decoder, generator.MLPNetwork2 = sized_decoder, sized_head
    generator.MappingNetwork = generator.SuperresolutionHybrid2X = lambda *a, **k: generator.nn.Identity()


def load_small(generator, checkpoint, config):
    from safetensors.torch import load_file

    with_sizes(generator, config)
    model = generator.Sat3DGen({**config, "backbone": "dinov3-large-sat"})
    weights = load_file(checkpoint / "diffusion_pytorch_model.safetensors")
    used = {key: value for key, value in weights.items() if not key.startswith(("sky_", "sr_module."))}
    missing, unknown = model.load_state_dict(used, strict=False)
    missing = [key for key in missing if not key.startswith("point_representer.")]
    if missing or unknown:
        sys.exit(f"{checkpoint}: tensors are missing: {missing}; or unknown: {unknown}")
    return model


def main():
    given = arguments()
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    sys.path.insert(0, str(given.checkout))
    import torch
    from PIL import Image

    torch.set_num_threads(given.threads)
    torch.Tensor.cuda = lambda self, *a, **k: self
    torch.cuda.is_available = lambda: False
    quiet = io.StringIO()
    with contextlib.redirect_stdout(quiet):
        from source import generator

    model_class = generator.Sat3DGen
    config = json.loads((given.checkpoint / "config.json").read_text())["opt"]
    if "backbone_config" in config:
        model_class._skip_backbone_weights = True
        model_class.from_pretrained = staticmethod(lambda folder: load_small(generator, given.checkpoint, config))

    seconds, network, whole_grid, whole_density = [], [], model_class.save_shape_from_sat, model_class.density_reg
    to_planes = model_class.from_sat_to_triplane

    def timed(into, function):
        def run(*positional, **named):
            start = time.perf_counter()
            result = function(*positional, **named)
            into.append(time.perf_counter() - start)
            return result

        return run

    def in_portions(self, coordinates, triplane_ori):
        parts = [
            whole_density(self, coordinates=coordinates[:, k : k + given.chunk], triplane_ori=triplane_ori)
            for k in range(0, coordinates.shape[1], given.chunk)
        ]
        return torch.cat(parts, 1)

    model_class.save_shape_from_sat = timed(seconds, whole_grid)
    model_class.from_sat_to_triplane = timed(network, to_planes)
    if given.chunk:
        model_class.density_reg = in_portions

    written = given.out / "reference"
    sys.argv = ["big_image_slice_inference.py", "--satellite_img_path", str(given.image)]
    sys.argv += ["--step_size", str(given.stride), "--model_path", str(given.checkpoint), "--output_dir", str(written)]
    sys.argv += ["--pixel_resolution", str(PIXEL), "--mesh_level", str(given.isovalue)]
    script = given.checkout / "inference" / "big_image_slice_inference.py"
    start = time.perf_counter()
    with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
        runpy.run_path(str(script), run_name="__main__")
    whole = time.perf_counter() - start
    (folder,) = written.glob("*/*")
    for name in ("density_volume.npz", "mesh.ply", "crop.png"):
        shutil.move(folder / name, given.out / name)
    shutil.rmtree(written)
    side = Image.open(given.out / "crop.png").size[0]
    result = {
        "side": side,
        "windows": len(seconds),
        "seconds": whole,
        "seconds_in_windows": sum(seconds),
        "seconds_in_network": sum(network),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2,
    }
    print(json.dumps(result))


main()
