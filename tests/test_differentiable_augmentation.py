"""What the discriminator sees: changes of DUSty's program, without its faults."""

import torch

from lidargrit.systems.dusty.differentiable_augmentation import augment_differentiably

IMAGES = torch.rand(500, 1, 32, 64, generator=torch.Generator().manual_seed(0)) * 2 - 1


def augmented(*kinds, images=IMAGES):
    return augment_differentiably(images, kinds, torch.Generator().manual_seed(1))


def test_brightness_goes_up_and_down():
    shift = (augmented("brightness") - IMAGES).flatten(1)
    assert torch.allclose(shift, shift[:, :1].expand_as(shift), atol=1e-6)  # one number an image
    assert abs(float(shift.mean())) < 0.05
    assert 0.48 < float(shift.max()) <= 0.5
    assert -0.5 <= float(shift.min()) < -0.48


def test_contrast_grows_and_shrinks_about_the_mean():
    found = augmented("contrast")
    factor = found.std((1, 2, 3)) / IMAGES.std((1, 2, 3))
    assert torch.allclose(found.mean((1, 2, 3)), IMAGES.mean((1, 2, 3)), atol=1e-6)
    assert 0.5 <= float(factor.min()) < 0.52
    assert 1.48 < float(factor.max()) <= 1.5


def shifts_of(found, rows, columns):
    """Return for each image by how many rows and columns it was moved, having checked every pixel."""
    shifts = []
    for one, before in zip(found[:, 0], IMAGES[: len(found), 0], strict=True):
        for down in range(-rows, rows + 1):
            moved = torch.zeros_like(before)
            kept = slice(max(0, -down), min(32, 32 - down))
            moved[kept] = before[max(0, down) : 32 + min(0, down)]
            for along in range(-columns, columns + 1):
                if torch.equal(one, moved.roll(-along, 1)):
                    shifts.append((down, along))
    assert len(shifts) == len(found)
    return shifts


def test_translation_turns_columns_and_lets_zeros_in_above_and_below():
    shifts = shifts_of(augmented("translation", images=IMAGES[:100]), 2, 4)  # a sixteenth of 32 and of 64
    assert {down for down, _ in shifts} == {-2, -1, 0, 1, 2}
    assert {along for _, along in shifts} == set(range(-4, 5))


def test_cutout_blanks_a_window_that_may_reach_over_an_edge():
    blank = augmented("cutout") == 0
    rows, columns = blank.any(3)[:, 0], blank.any(2)[:, 0]
    for size, found in ((32, rows), (64, columns)):
        length = found.sum(1)
        assert int(length.max()) == size // 2
        assert int(length.min()) == size // 4  # centred on an edge
    assert torch.equal(blank[:, 0], rows[:, :, None] & columns[:, None, :])


def test_gradients_flow_to_every_pixel_that_is_seen():
    images = IMAGES[:4].clone().requires_grad_()
    found = augmented("brightness", "contrast", "translation", "cutout", images=images)
    found.sum().backward()
    assert images.grad is not None
    assert bool(images.grad.isfinite().all())
    assert 0.3 < float((images.grad != 0).float().mean()) <= 1
