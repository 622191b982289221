"""The networks that regress poses, in torch: an image to six numbers, and an LSTM over a window of images."""

from __future__ import annotations

from typing import Any

from semdb.perception.torch_models import import_torch, load_weights, read_checkpoint, state_dict_of
from semdb.training.pose_options import FROZEN, PoseOptions

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, which published weights were trained on
_SQUEEZED = 32  # channels that a frozen map is brought to
_HIDDEN, _LAYERS = 256, 2
_DEPTH_SCALE = 2.0 / 255  # from the bytes of a plane of depth to units of 4 m


def build(options: PoseOptions, shape: tuple[int, ...]) -> Any:
    """The network for inputs of `shape` ``(C, h, w)``, with random weights of torch's generator.

    ``single(x)`` gives features ``[B, width]`` and poses ``[B, 6]``, ``filtered(features, poses)`` those of windows.
    The two log variances of the loss, which learn too, begin at 0 and -3 (Kendall and Cipolla, CVPR 2017).
    Raises ModelError for weights that do not fit.
    """
    torch = import_torch()
    nn = torch.nn
    trunk, size = _frozen_trunk(nn, shape) if options.backbone == FROZEN else _trunk(options, shape[0], nn)
    network = nn.Module()
    network.trunk = trunk
    network.feature = nn.Linear(size, options.features)
    network.dropout = nn.Dropout(options.dropout)
    network.position, network.rotation = nn.Linear(options.features, 3), nn.Linear(options.features, 3)
    network.log_variance = nn.Parameter(torch.tensor([0.0, -3.0]))
    network.register_buffer("spread", torch.ones(6))
    if options.frames > 1:
        network.lstm = nn.LSTM(options.features + 6, _HIDDEN, _LAYERS, batch_first=True)
        network.residual = nn.Linear(_HIDDEN, 6)
        nn.init.zeros_(network.residual.weight)
        nn.init.zeros_(network.residual.bias)
    return network


def single(network: Any, x: Any) -> tuple[Any, Any]:
    """Features ``[B, width]`` and poses ``[B, 6]`` of inputs ``[B, C, h, w]``, each image by itself."""
    feature = network.feature(network.trunk(x).flatten(1)).relu()
    kept = network.dropout(feature)
    torch = import_torch()
    return feature, torch.cat([network.position(kept), network.rotation(kept)], dim=1) * network.spread


def filtered(network: Any, features: Any, poses: Any) -> Any:
    """Poses ``[B, 6]`` of the last of each window, from features ``[B, W, width]`` and poses ``[B, W, 6]``.

    The LSTM reads forward, so it sees nothing that comes after, and corrects the pose of the single image.
    """
    torch = import_torch()
    read, _ = network.lstm(torch.cat([network.dropout(features), poses / network.spread], dim=2))
    return poses[:, -1] + network.residual(read[:, -1]) * network.spread


def loss_of(network: Any, found: Any, wanted: Any) -> Any:
    """``L_x e^-s_x + s_x + L_q e^-s_q + s_q`` with absolute errors: the two weigh themselves against each other."""
    apart = (found - wanted).abs()
    position, rotation = apart[:, :3].sum(1).mean(), apart[:, 3:].sum(1).mean()
    x, q = network.log_variance
    return position * (-x).exp() + x + rotation * (-q).exp() + q


def as_floats(inputs: Any, light: Any | None = None) -> Any:
    """Inputs as float32: bytes of pixels normalised as ImageNet's, brighter or darker by `light` ``[B]``."""
    torch = import_torch()
    if inputs.dtype != torch.uint8:
        return inputs.float()
    x = inputs.float()
    colour = x[:, :3] / 255
    if light is not None:
        colour = (colour * light[:, None, None, None]).clamp(0, 1)
    mean, std = (torch.tensor(v, device=x.device)[None, :, None, None] for v in (_MEAN, _STD))
    return torch.cat([(colour - mean) / std, x[:, 3:] * _DEPTH_SCALE], dim=1)


def _frozen_trunk(nn: Any, shape: tuple[int, ...]) -> tuple[Any, int]:
    """One convolution 1x1 over the cells of a frozen map, which depth widens as it does the first of a network."""
    trunk = nn.Sequential(nn.Conv2d(shape[0], _SQUEEZED, 1), nn.ReLU())
    return trunk, _SQUEEZED * shape[1] * shape[2]


def _trunk(options: PoseOptions, channels: int, nn: Any) -> tuple[Any, int]:
    import torchvision

    network = getattr(torchvision.models, options.backbone)(weights=None)
    resnet = options.backbone.startswith("resnet")
    size = 512 if resnet else 1280
    setattr(network, "fc" if resnet else "classifier", nn.Identity())
    if options.weights is not None:
        tensors = state_dict_of(read_checkpoint(options.weights), options.weights)
        tensors = {name: v for name, v in tensors.items() if not name.startswith(("fc.", "classifier."))}
        load_weights(network, tensors, options.weights, options.backbone)
    if channels > 3:
        if resnet:
            network.conv1 = _widened(network.conv1, nn)
        else:
            network.features[0][0] = _widened(network.features[0][0], nn)
    return network, size


def _widened(first: Any, nn: Any) -> Any:
    """A first convolution with a fourth channel, which starts as the mean of the three of colour."""
    torch = import_torch()
    wide = nn.Conv2d(4, first.out_channels, first.kernel_size, first.stride, first.padding, bias=first.bias is not None)
    with torch.no_grad():
        wide.weight.copy_(torch.cat([first.weight, first.weight.mean(dim=1, keepdim=True)], dim=1))
    return wide
