"""Two rules from the literature, written as rules of one's own; see own-rule.md."""

import numpy as np
from numpy.linalg import inv


class InverseCovarianceIntersection:
    """Inverse covariance intersection: what two estimates may at most have in common is removed.

    P⁻¹ = A⁻¹ + B⁻¹ − Γ⁻¹,  Γ = ωA + (1−ω)B,  K = P (A⁻¹ − ωΓ⁻¹),  L = P (B⁻¹ − (1−ω)Γ⁻¹),  ω of least trace.
    """

    title = "inverse covariance intersection, two at a time"
    source = "Noack, Sijs, Reinhardt and Hanebeck 2017"
    pairs = True  # own estimate and first heard, the result and the next, …

    def fuse(self, x, P):
        A, B = P

        def fused(ω):
            return inv(inv(A) + inv(B) - inv(ω * A + (1 - ω) * B))

        low, high = 0.0, 1.0
        for _ in range(12):  # nine weights at a time, around the best of the nine before
            ω = np.linspace(low, high, 9)
            traces = np.trace(fused(ω[:, None, None]), axis1=1, axis2=2)
            best = (traces * (1 + 1e-9 * abs(ω - 0.5))).argmin()  # where all are as good, the middle
            low, high = ω[max(best - 1, 0)], ω[min(best + 1, 8)]
        ω = ω[best]
        common, C = inv(ω * A + (1 - ω) * B), fused(ω)
        return C @ (inv(A) - ω * common) @ x[0] + C @ (inv(B) - (1 - ω) * common) @ x[1], C


class DiffusionKalman:
    """Diffusion Kalman filter: estimates are averaged, the covariance stays that of the agent's own filter."""

    title = "diffusion of local Kalman filters, like weights"
    source = "Cattivelli and Sayed 2010, measurements not exchanged"
    batched = True  # x (items, m, d, c), P (items, m, d, d): many fusions in one call

    def fuse(self, x, P):
        return x.mean(axis=1), P[:, 0]
