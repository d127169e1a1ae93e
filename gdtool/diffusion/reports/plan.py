"""Predict the cost of a training: memory and FLOPs of a step, and the time on GPUs and on this machine's processor.

Nothing but the GPUs' data is taken from a table, and the processor's speed is probed. The network is built on PyTorch's
meta device, which holds shapes and no values, and a step is run there forward and backward. torch.utils.flop_counter
counts FLOPs; memory is the sum of live storages. The VAE and CLIP are measured in the same way. The rendering loss is
run on real numbers, since it is small.
"""

from __future__ import annotations

import contextlib
import weakref
from pathlib import Path

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig, Phase, TrainConfig
from gdtool.diffusion.network import attention
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.codec import CHUNK, VaeCodec
from gdtool.diffusion.network.encoding import PLANES
from gdtool.diffusion.network.model import Condition, Model, parameter_count, structure
from gdtool.diffusion.network.schedule import alpha_and_sigma
from gdtool.diffusion.reports.report import machine
from gdtool.diffusion.shape.network import PICTURE_CHANNELS, ShapeNetwork
from gdtool.diffusion.shape.volume import volume_side
from gdtool.diffusion.training.arithmetic import choose_arithmetic
from gdtool.diffusion.training.losses import SHADED_DOMAINS, LitObject, rendering_error, view_directions

# Dense bfloat16 peak in FLOP/s, memory in bytes, NVLink in bytes/s in one direction (NVIDIA's data sheets, SXM parts).
GPUS = {"A100 80 GB": (312e12, 80e9, 300e9), "H100 80 GB": (989e12, 80e9, 450e9), "H200 141 GB": (989e12, 141e9, 450e9)}
# Share of the peak that training a UNet of this size in bfloat16 commonly reaches: an assumption, the only one here.
UTILISATION = 0.35
# Share of the speed of one large matrix product (training/arithmetic.py) that a training reaches on a processor,
# measured with the preset "volume" on a Zen 5 core in bfloat16, both parts alike.
CPU_UTILISATION = 0.35
# Held for each weight: itself, its gradient, two moments and the average in float32, and autocast's copy in bfloat16.
BYTES_PER_WEIGHT = 4 + 4 + 8 + 4
GB = 1e9


class LiveBytes(TorchDispatchMode):
    """Measure the peak of the bytes that results of operations hold, those kept for the backward pass included."""

    def __init__(self):
        super().__init__()
        self.live = self.peak = 0
        self.sizes: dict[int, int] = {}

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """Run an operation and add the bytes of each storage that it allocates."""
        out = function(*args, **(kwargs or {}))
        inputs = {x.untyped_storage()._cdata for x in _tensors(args)}
        for x in _tensors(out):
            storage = x.untyped_storage()
            key, size = storage._cdata, storage.nbytes()
            if key in inputs or key in self.sizes:  # a view, or written in place
                continue
            self.sizes[key] = size
            self.live += size
            self.peak = max(self.peak, self.live)
            weakref.finalize(storage, self._freed, key)
        return out

    def _freed(self, key: int) -> None:
        """Subtract the bytes of a storage that was freed."""
        self.live -= self.sizes.pop(key, 0)


def _tensors(x):
    """Yield the tensors in nested lists and tuples."""
    if isinstance(x, torch.Tensor):
        yield x
    elif isinstance(x, list | tuple):
        for item in x:
            yield from _tensors(item)


@contextlib.contextmanager
def fused_attention():
    """Replace attention.attend() by the GPUs' fused kernel, which does not store the attention matrix."""
    before = attention.attend

    def fused(q, k, v):
        """Attend as attention.attend() does, by the fused kernel."""
        flat = (x.flatten(0, -4) for x in (q, k, v))
        return torch.ops.aten._scaled_dot_product_flash_attention(*flat)[0].view(*q.shape[:-1], v.shape[-1])

    attention.attend = fused
    try:
        yield
    finally:
        attention.attend = before


def step_cost(
    config: ModelConfig,
    domains: int,
    views: int,
    objects: int,
    *,
    fused: bool,
    dtype=torch.bfloat16,
    device: str = "meta",
) -> dict[str, float]:
    """Measure the FLOPs and the peak bytes of one forward and backward pass of the network.

    The bytes leave out weights and their gradients.

    Args:
        config: of the model.
        domains: number of domains.
        views: number of views.
        objects: number of objects.
        fused: whether attention uses a fused kernel, as on a GPU; otherwise it runs as attend() does on this device.
        dtype: of weights and activations.
        device: where the pass runs; "meta" computes no values.
    """
    # Two passes, since the FLOP counter keeps tensors alive that checkpointing would have freed.
    counter, memory = FlopCounterMode(display=False), LiveBytes()
    for watch in (counter, memory):
        model = _one_step(config, domains, views, objects, fused, dtype, device, watch)
    gradients = sum(p.numel() * p.element_size() for p in model.parameters() if p.grad is not None)
    return {"flops": float(counter.get_total_flops()), "bytes": float(memory.peak - gradients)}


def _one_step(
    config: ModelConfig, domains: int, views: int, objects: int, fused: bool, dtype, device: str, watch
) -> Model:
    """Run a forward and backward pass inside the context `watch`, and return the model with its gradients.

    The other parameters are those of step_cost(), hence eight in all.
    """
    model = structure(config, device).to(dtype).train()
    layout = Layout(objects, tuple(range(len(DOMAINS)))[:domains], views)
    view_idx = torch.arange(views)
    shape = model.latent_shape(layout)
    with torch.device(device):
        noisy, clean = torch.zeros(shape, dtype=dtype), torch.zeros(shape)
        condition = _empty_condition(model, layout, dtype)
        rgba = torch.zeros(objects, 4, config.image_size, config.image_size, dtype=dtype)
        context = torch.zeros(objects, 1, config.encoder_width, dtype=dtype)
        model.labels, t = model.labels.to(dtype), torch.zeros(objects, dtype=torch.long)
        model.alpha, model.sigma = model.alpha.to(dtype), model.sigma.to(dtype)
    # sinusoid() returns float32; the hook casts it to the weights' type
    hook = model.unet.time_embedding.register_forward_pre_hook(lambda module, args: (args[0].to(dtype),))
    with fused_attention() if fused else contextlib.nullcontext(), watch:
        if config.encoder == "patch":
            context = model.encoder(rgba)
        predicted = model.predict_clean(noisy, condition, t, context, layout, view_idx)
        (predicted - clean).square().mean().backward()
    hook.remove()
    return model


def shape_step_cost(config: ModelConfig, objects: int, dtype=torch.bfloat16) -> dict[str, float]:
    """Measure a forward and backward pass of the shape network, as step_cost() does for that of the views."""
    assert config.shape is not None
    counter, memory = FlopCounterMode(display=False), LiveBytes()
    for watch in (counter, memory):
        side = volume_side(config.image_size)
        with torch.device("meta"):
            network = ShapeNetwork(config.shape, side).to(dtype)
            picture = torch.zeros(objects, PICTURE_CHANNELS, side, side, dtype=dtype)
            space = torch.zeros(objects, side, side, side, dtype=dtype)
            code, known = torch.zeros(objects, config.shape.code, dtype=dtype), torch.zeros(objects, dtype=dtype)
        with watch:
            network(picture, space, code, known).square().mean().backward()
    gradients = sum(p.numel() * p.element_size() for p in network.parameters() if p.grad is not None)
    return {"flops": float(counter.get_total_flops()), "bytes": float(memory.peak - gradients)}


def _empty_condition(model: Model, layout: Layout, dtype) -> Condition:
    """Make a condition of zeros for a layout, with all inputs that the model reads."""
    side, config = model.codec.side, model.config
    if config.domain_layout == "images":
        return Condition(torch.zeros(layout.images, model.codec.condition_channels, side, side, dtype=dtype))
    latents = len(layout.domains) * model.codec.latent_channels
    inputs = model.conv_mix.in_channels - latents
    return Condition(torch.zeros(layout.objects * layout.views, inputs, side, side, dtype=dtype))


def frozen_cost(config: ModelConfig) -> dict[str, float] | None:
    """Measure the cost of the frozen VAE and CLIP; None where diffusers or transformers is not installed.

    Returns FLOPs: encode and decode of an image by the VAE (decode with its gradient), object for CLIP. Returns bytes:
    encode_bytes and decode_bytes, the peak of a call, which does not grow with the batch; weights_bytes in float32.
    """
    cost = dict.fromkeys(("encode", "decode", "object", "encode_bytes", "decode_bytes", "weights_bytes"), 0.0)
    try:
        if config.codec == "vae":
            codec = VaeCodec(config, frozen_part(config, "vae"))
            shape = (CHUNK, 4, codec.side, codec.side)
            images = torch.zeros(CHUNK, 3, config.image_size, config.image_size, device="meta")
            cost["encode"], cost["encode_bytes"] = _measure_call(lambda: codec.encode(images))
            cost["decode"], cost["decode_bytes"] = _measure_call(
                lambda: codec.decode(torch.zeros(shape, device="meta", requires_grad=True)).sum().backward()
            )
            cost["encode"], cost["decode"] = cost["encode"] / CHUNK, cost["decode"] / CHUNK
            cost["weights_bytes"] += 4.0 * parameter_count(codec.vae)
        if config.encoder == "clip":
            clip = frozen_part(config, "image_encoder").requires_grad_(False)
            cost["object"], _ = _measure_call(lambda: clip(torch.zeros(1, 3, 224, 224, device="meta")))
            cost["weights_bytes"] += 4.0 * parameter_count(clip)
    except ImportError:
        return None
    return cost


def frozen_part(config: ModelConfig, part: str) -> torch.nn.Module:
    """Build the vae or the image_encoder on the meta device, without values.

    Its structure is that of config.pretrained where this is a local folder, else that of Image Variations.
    """
    from diffusers import AutoencoderKL
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    described = Path(config.pretrained) / part / "config.json" if config.pretrained else Path()
    with torch.device("meta"):
        if part == "image_encoder":
            return CLIPVisionModelWithProjection(
                CLIPVisionConfig.from_json_file(described)
                if described.is_file()
                else CLIPVisionConfig(
                    hidden_size=1024,
                    intermediate_size=4096,
                    projection_dim=768,
                    num_hidden_layers=24,
                    num_attention_heads=16,
                    image_size=224,
                    patch_size=14,
                )
            )
        if described.is_file():
            return AutoencoderKL.from_config(AutoencoderKL.load_config(described.parent))
        return AutoencoderKL(
            down_block_types=("DownEncoderBlock2D",) * 4,
            up_block_types=("UpDecoderBlock2D",) * 4,
            block_out_channels=(128, 256, 512, 512),
            layers_per_block=2,
            latent_channels=4,
        )


def _measure_call(call) -> tuple[float, float]:
    """Measure the FLOPs and the peak bytes of call(), which is run twice."""
    counter, memory = FlopCounterMode(display=False), LiveBytes()
    with counter:
        call()
    with memory:
        call()
    return float(counter.get_total_flops()), float(memory.peak)


def rendering_share(config: ModelConfig, train: TrainConfig, domains: int) -> float:
    """Compute the mean share of a step's objects, 0 to 1, to which the rendering loss applies.

    domains: how many a step has; with less than all of them there is no rendering loss.
    """
    lit = {DOMAINS.index(d) for d in SHADED_DOMAINS} <= {DOMAINS.index(d) for d in config.domains} and domains == len(
        config.domains
    )
    if not lit or train.pbr_weight == 0:
        return 0.0
    alpha, sigma = alpha_and_sigma(config)
    near = (alpha / sigma).square() > train.pbr_snr
    return float(near.float().mean()) * (1 - train.pure_noise) + train.pure_noise * float(near[-1])


def shading_bytes(config: ModelConfig, train: TrainConfig, views: int) -> float:
    """Measure the peak bytes of one object's rendering loss, with the decoded images of `views` views."""
    shape = (len(SHADED_DOMAINS), views, 3, config.image_size, config.image_size)
    planes = torch.ones(views, PLANES["mask"].stop, *shape[-2:])
    lights = torch.tensor([[0.0, 0, 1, 1, 1, 1, 1]]).repeat(16, 1)
    order = {DOMAINS.index(d): j for j, d in enumerate(SHADED_DOMAINS)}
    memory, start = LiveBytes(), torch.rand(shape)
    with memory:
        predicted = start.clone().requires_grad_()
        rendering_error(
            predicted,
            start,
            order,
            LitObject(planes=planes, lights=lights, views=view_directions(config)[:views], background=0.0),
            pixels=train.pbr_pixels,
            generator=torch.Generator(),
        ).backward()
    return float(memory.peak)


def data_bytes(config: ModelConfig, domains: int, views: int) -> float:
    """Compute the bytes of one object's data in a step with so many domains and views.

    The data are its planes, their encoding, and the clean, noise, noisy and condition latents, in float32.
    """
    codec = structure(config).codec
    pixels, latent = config.image_size**2, codec.side**2
    images = domains * views
    return 4.0 * (
        PLANES["mask"].stop * pixels * (len(config.views) + views)
        + images * 3 * pixels
        + images * latent * (3 * codec.latent_channels + codec.condition_channels)
    )


def make_plan(config: ModelConfig, train: TrainConfig) -> dict:
    """Build the report of `gdtool train --plan`: weights, and for each phase FLOPs, memory and seconds of a step."""
    model = structure(config)
    trained = model.shape if train.part == "shape" and model.shape is not None else model
    weights = parameter_count(trained)
    frozen = frozen_cost(config)
    processor = choose_arithmetic("cpu")
    report: dict = {
        "weights": weights,
        "weights_bytes": weights * BYTES_PER_WEIGHT,
        "steps": train.steps,
        "utilisation": UTILISATION,
        "frozen_parts_counted": frozen is not None,
        "phases": [],
        "hours": {},
    }
    processor_hours = 0.0
    done, hours = 0.0, {(gpu, n): 0.0 for gpu in GPUS for n in (1, 8)}
    for phase in train.phases:
        steps, done = round((phase.share - done) * train.steps), phase.share
        cost = phase_cost(config, train, phase, frozen, weights)
        report["phases"].append({"steps": steps, **cost})
        processor_hours += steps * cost["flops_per_step"] / (processor.flops * CPU_UTILISATION) / 3600
        for gpu, (peak, _, link) in GPUS.items():
            for n in (1, 8):
                # Ring all-reduce of float32 gradients.
                exchange = 0.0 if n == 1 else 2 * (n - 1) / n * weights * 4 / link
                hours[gpu, n] += steps * (cost["flops_per_step"] / (n * peak * UTILISATION) + exchange) / 3600
    for gpu, (_, capacity, _) in GPUS.items():
        # each part of a batch is split over the GPUs
        fits = {
            str(n): max(
                p["bytes"] - p["growing_bytes"] * (1 - -(-p["objects_at_once"] // n) / p["objects_at_once"])
                for p in report["phases"]
            )
            < 0.9 * capacity
            for n in (1, 8)
        }
        report["hours"][gpu] = {"1": hours[gpu, 1], "8": hours[gpu, 8], "fits": fits}
    report["processor"] = {
        "name": machine(),
        "precision": processor.precision,
        "probe_flops": processor.flops,
        "utilisation": CPU_UTILISATION,
        "hours": processor_hours,
    }
    return report


def phase_cost(
    config: ModelConfig, train: TrainConfig, phase: Phase, frozen: dict | None, weights: int, *, fused: bool = True
) -> dict:
    """Compute the FLOPs of a step of a phase, averaged over the timesteps, and its peak bytes, by name.

    The rendering loss applies to objects with little noise: FLOPs count their mean number, bytes count every object.
    frozen: as frozen_cost() returns it. weights: number of trained weights.
    """
    domains, views = min(phase.domains, len(config.domains)), min(phase.views, len(config.views))
    batch = phase.batch or train.batch
    part = -(-batch // train.accumulate)
    dtype = torch.float32 if train.precision == "float32" else torch.bfloat16
    if train.part == "shape":
        one_object, two_objects = (shape_step_cost(config, n, dtype) for n in (1, 2))
    else:
        one_object, two_objects = (step_cost(config, domains, views, n, fused=fused, dtype=dtype) for n in (1, 2))
    # both are affine in the number of objects: measured at one and two, not assumed
    flops, network = (one_object[key] + (two_objects[key] - one_object[key]) * (part - 1) for key in ("flops", "bytes"))
    share = rendering_share(config, train, domains)
    data = part * data_bytes(config, domains, views)
    rendering = part * shading_bytes(config, train, views) if share else 0.0
    conditions = 1 + (config.mirror_back and "back" in config.views)
    frozen_figures = frozen or dict.fromkeys(
        ("encode", "decode", "object", "encode_bytes", "decode_bytes", "weights_bytes"), 0.0
    )
    encoding = frozen_figures["encode"] * (domains * views + conditions)
    decoding = frozen_figures["decode"] * share * len(SHADED_DOMAINS) * views
    growing = data + network + rendering
    held = max(data + frozen_figures["encode_bytes"], growing + (frozen_figures["decode_bytes"] if share else 0.0))
    copies = weights * 2 if dtype == torch.bfloat16 else 0
    return {
        "domains": domains,
        "views": views,
        "batch": batch,
        "objects_at_once": part,
        "flops_per_step": flops * batch / part + batch * (encoding + decoding + frozen_figures["object"]),
        "vae_flops_per_step": batch * (encoding + decoding),
        "rendering_share": share,
        "rendering_bytes": rendering,
        "growing_bytes": growing,
        "activation_bytes": held,
        "bytes": weights * BYTES_PER_WEIGHT + copies + frozen_figures["weights_bytes"] + held,
    }


def format_plan(report: dict) -> str:
    """Format the report of make_plan() as lines for a terminal."""
    lines = [
        f"{report['weights'] / 1e6:.1f} million weights: {report['weights_bytes'] / GB:.2f} GB "
        "with gradients, moments and average",
        "",
        "phase  steps    batch  at once  domains x views  PFLOP/step  activations  memory",
    ]
    for i, p in enumerate(report["phases"], 1):
        lines.append(
            f"{i:5d}  {p['steps']:<7d}  {p['batch']:5d}  {p['objects_at_once']:7d}  "
            f"{p['domains']:7d} x {p['views']:<5d}  "
            f"{p['flops_per_step'] / 1e15:10.4g}  {p['activation_bytes'] / GB:8.2f} GB  {p['bytes'] / GB:6.2f} GB"
        )
    lines += ["", f"estimated at {report['utilisation']:.0%} of the peak in bfloat16:"]
    for gpu, row in report["hours"].items():
        one_gpu, eight_gpus = (
            f"{row[n]:8.1f} h{'' if row['fits'][n] else ' (does not fit: raise accumulate)'}" for n in ("1", "8")
        )
        lines.append(f"{gpu:12s}  1 GPU {one_gpu}   8 GPUs {eight_gpus}")
    here = report["processor"]
    lines.append(
        f"this machine, {here['name']}, in {here['precision']}: {here['hours']:.1f} h, at {here['utilisation']:.0%} of "
        f"the {here['probe_flops'] / 1e9:.0f} GFLOP/s that a matrix product reached just now"
    )
    if not report["frozen_parts_counted"]:
        lines.append("not counted: the frozen VAE and CLIP (pip install 'gdtool[hub]')")
    return "\n".join(lines)
