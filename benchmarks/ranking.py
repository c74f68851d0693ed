"""Which distance tells real scans from simulated, generated and damaged ones, and grows with the damage.

    python benchmarks/ranking.py choosing --real SHARED/real --out choosing      # may be looked at as often as one likes
    python benchmarks/ranking.py hidden --real SHARED/real --out hidden          # once, when everything is chosen

Written down before the first run.

**Damage.** The 56 kinds of `damage.py` at three levels, of which 28 choose and 28 are hidden. The half `choosing`
measures its 28 kinds on scenes of simulator seed 1701 and on the real drives odometry 00, raw 0005 and object. The half
`hidden` measures all 56, the hidden ones apart, on scenes of seed 1702 and on KITTI-360 0000, raw 0048 and odometry 08.

d_0 is the distance of undamaged scans from the reference, d_1 to d_3 that of the same scans with the damage of a level.
Simulated: 96 scans of 64 x 1024 from 96 others. Real: the scans of a half in two at random, the mean over 10 draws.
The floor is the distance of two sets of undamaged scans of the same sizes, drawn at random 100 times.

- A kind **grows** where d_0 < d_1 < d_2 < d_3.
- A level is **seen** where its distance is above all 100 floors.
- A kind **passes** where it grows and its last level is seen.
- The headline passes where all hidden kinds pass on simulated scans, and nine of ten on the few real ones.

**Choice.** Candidates: hand-made features of 1, 2, 4 or 8 bands of rows with 0, 4, 8 or 16 sectors of azimuth, scaled by
fixed numbers or by the spread of the real set, under KID or the Frechet distance. Chosen is the one of which most of
the 28 kinds pass on simulated and on real scans together; of equal ones that which sees more levels, then the simpler.
Beside it: the shipped network, the same with random weights, JSD and MMD.

**Ranking.** At 32 x 256, the size of the model `street`, KID from the held-out real scans must rise along: other real
drives, simulated scans (seed 1702, 128), 128 samples of `street` (seed 1) of 32 evaluations, of 1 evaluation, shuffled
pixels, noise. In the half `choosing` the held-out drives are odometry 00 and object, the other one is raw 0005; in the
half `hidden` they are KITTI-360 0000, and the others are all that choosing had, raw 0048 and odometry 08.

**Sizes.** KID is the headline where it sees more levels than Frechet from as many scans: simulated scans of 32 x 256,
the 28 hidden kinds, 125 to 2,000 scans a side.
"""
