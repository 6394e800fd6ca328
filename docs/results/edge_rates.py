"""How many edges scans have → a Markdown table: folders of samples, or other sources of range images.

    python docs/results/edge_rates.py table/small_pixels/samples simulated:256:test

Counted are neighbours in a row that both return and are more than 2 m apart, and returns that are more than 1 m nearer,
or farther, than both of their neighbours, where these agree within a tenth of their range. Rows are circular.
"""

import argparse

from lidargrit.data.sources import open_images

FAR_M, BESIDE_M, ONE_SURFACE = 2.0, 1.0, 0.1


def shares(source: str, scans: int) -> tuple[float, float, float]:
    """Return the three shares over the first scans of a source."""
    opened = open_images(source)
    images = opened.batch(list(range(min(scans, len(opened)))))
    returned, range_m = images.return_mask, images.range_m
    (left, right), (has_left, has_right) = ([one.roll(step, -1) for step in (1, -1)] for one in (range_m, returned))
    pairs = returned & has_right
    apart = pairs & ((range_m - right).abs() > FAR_M)
    nearest, farthest = left.minimum(right), left.maximum(right)
    all_three = returned & has_left & has_right
    on_one_surface = all_three & (farthest - nearest < ONE_SURFACE * nearest)
    nearer = on_one_surface & (range_m < nearest - BESIDE_M)
    farther = on_one_surface & (range_m > farthest + BESIDE_M)
    counts = [float(of.sum()) for of in (apart, pairs, nearer, farther, all_three)]
    return counts[0] / counts[1], counts[2] / counts[4], counts[3] / counts[4]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("-n", type=int, default=256, help="scans of each, the first (default: 256)")
    options = parser.parse_args()
    print(f"| | neighbours > {FAR_M:g} m apart | nearer than both | farther than both |\n|---|---|---|---|")
    for source in options.sources:
        print(f"| {source} | " + " | ".join(f"{share:.2%}" for share in shares(source, options.n)) + " |")


if __name__ == "__main__":
    main()
