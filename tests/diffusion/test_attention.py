"""Check attention across views and domains against its formula."""

import pytest
import torch

from gdtool.diffusion.network.attention import Attention, CrossDomainAttention, Layout, RowAttention, TransformerBlock


def block(cross_domain="two_way", multi_view=True):
    torch.manual_seed(0)
    return TransformerBlock(16, 2, 8, 2, multi_view, cross_domain).double()


def tokens(layout, t=4, c=16):
    return torch.randn(layout.images, t, c, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_attention_is_softmax_of_scaled_products():
    torch.manual_seed(0)
    attention = Attention(8, 2).double()
    x = torch.randn(1, 5, 8, dtype=torch.float64)
    q, k, v = (layer(x)[0] for layer in (attention.to_q, attention.to_k, attention.to_v))
    heads = []
    for h in range(2):
        part = slice(4 * h, 4 * h + 4)
        scores = q[:, part] @ k[:, part].T / 2.0
        weights = scores.exp() / scores.exp().sum(1, keepdim=True)
        heads.append(weights @ v[:, part])
    torch.testing.assert_close(attention(x)[0], attention.to_out[0](torch.cat(heads, 1)))


def test_cross_domain_attention_starts_without_effect():
    layout = Layout(1, (0, 1, 2), 2)
    x = tokens(layout)
    with_star, without = block("two_way"), block("none")
    without.load_state_dict({k: v for k, v in with_star.state_dict().items() if "cross_domain" not in k})
    context = torch.randn(1, 3, 8, dtype=torch.float64)
    torch.testing.assert_close(with_star(x, context, layout), without(x, context, layout), rtol=0, atol=0)


def trained_star(two_way):
    torch.manual_seed(0)
    star = CrossDomainAttention(16, 2, two_way).double()
    torch.nn.init.normal_(star.to_out[0].weight)
    return star


def test_star_formula_for_color():
    """Color's residual is one linear layer over what its queries read from each other domain of the same view."""
    star, layout = trained_star(False), Layout(1, (0, 2, 4), 2)
    x = tokens(layout).view(3, 2, 4, 16)
    read = []
    for domain in range(1, 6):
        place = {2: 1, 4: 2}.get(domain)
        if place is None:
            read.append(torch.zeros(2, 4, 16, dtype=torch.float64))
            continue
        q, k, v = star.to_q(x[0]), star.to_k(x[place]), star.to_v(x[place])
        heads = [
            torch.softmax(q[..., p] @ k[..., p].transpose(-1, -2) / 8**0.5, -1) @ v[..., p]
            for p in (slice(0, 8), slice(8, 16))
        ]
        read.append(torch.cat(heads, -1))
    expected = star.to_out[0](star.fuse(torch.cat(read, -1)))
    torch.testing.assert_close(star(x.flatten(0, 1), layout).view(3, 2, 4, 16)[0], expected)


def test_color_reaches_the_other_domains_in_the_two_way_star_only():
    layout = Layout(1, (0, 1, 5), 2)
    x = tokens(layout)
    changed = x.clone()
    changed[:2] += 1.0  # color, both views
    for two_way in (False, True):
        star = trained_star(two_way)
        moved = (star(x, layout) - star(changed, layout)).view(3, 2, 4, 16).abs().amax((2, 3))
        assert (moved[0] > 1e-6).all()
        assert ((moved[1:] > 1e-6) == two_way).all()


def test_star_stays_in_its_view_and_object():
    layout = Layout(2, (0, 3), 2)
    star, x = trained_star(True), tokens(layout)
    changed = x.clone()
    changed[0] += 1.0  # object 0, color, view 0
    moved = (star(x, layout) - star(changed, layout)).abs().amax((1, 2)).view(2, 2, 2)
    assert (moved[0, :, 0] > 1e-6).all()
    assert (moved[0, :, 1] == 0).all()
    assert (moved[1] == 0).all()


@pytest.mark.parametrize("domains", [(0,), (1, 2)])
def test_star_without_partners_is_zero(domains):
    layout = Layout(1, domains, 2)
    assert (trained_star(True)(tokens(layout), layout) == 0).all()


def test_multi_view_attention_reads_all_views_of_one_domain():
    layout = Layout(1, (0, 1), 3)
    x, context = tokens(layout), torch.zeros(1, 3, 8, dtype=torch.float64)
    changed = x.clone()
    changed[0, 0, 0] += 1.0  # color, view 0
    for multi_view in (False, True):
        network = block("none", multi_view)
        moved = (network(x, context, layout) - network(changed, context, layout)).abs().amax((1, 2)).view(2, 3)
        assert moved[0, 0] > 0
        assert ((moved[0, 1:] > 0) == multi_view).all()
        assert (moved[1] == 0).all()


def test_permuted_views_give_permuted_features():
    """Attention does not depend on the order of the views."""
    layout, context = Layout(1, (0, 1), 3), torch.randn(1, 3, 8, dtype=torch.float64)
    network = block()
    torch.nn.init.normal_(network.attn_cross_domain.to_out[0].weight)
    x = tokens(layout).view(2, 3, 4, 16)
    order = [2, 0, 1]
    direct = network(x.flatten(0, 1), context, layout).view(2, 3, 4, 16)[:, order]
    torch.testing.assert_close(network(x[:, order].flatten(0, 1), context, layout).view(2, 3, 4, 16), direct)


def test_row_attention_starts_as_the_identity_and_reads_one_row_of_all_views():
    torch.manual_seed(0)
    layout, network = Layout(1, (0, 1), 3), RowAttention(16, 2, 4, 4).double()
    x = torch.randn(layout.images, 16, 5, 4, dtype=torch.float64)
    assert torch.equal(network(x, layout), x)
    torch.nn.init.normal_(network.attn.to_out[0].weight)
    network.norm = torch.nn.Identity()  # its statistics are the whole image's
    changed = x.clone()
    changed[1, :, 2, 3] += 1.0  # color, view 1, row 2
    moved = (network(x, layout) - network(changed, layout)).abs().amax(1)  # (images, rows, columns)
    assert (moved[:3, 2] > 0).all()
    assert (moved[:3, [0, 1, 3, 4]] == 0).all()
    assert (moved[3:] == 0).all()
