/* Task 2 with white or band-limited noise, Heun, single precision: SEEDS trajectories side by side, so that the compiler makes
   vectors of them. Normals by Box and Muller from a counter-based hash, so that a seed's numbers depend on nothing else. */
#include <math.h>
#include <stdint.h>

#define LANES 32

typedef float Row[LANES];

static inline uint32_t mixed(uint32_t x)
{
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    return x ^ (x >> 16);
}

/* `count` normals of step k for the seeds from `first` on. */
static inline void normals(Row *z, int count, int first, int k)
{
    Row radius[4], angle[4]; /* sines and cosines in loops of their own, else no vectors */
    for (int j = 0; j < count / 2; j++) {
        for (int i = 0; i < LANES; i++) {
            uint32_t counter = mixed((uint32_t)(first + i) * 0x9e3779b9u + 1u) + (uint32_t)(count * k + 2 * j);
            radius[j][i] = sqrtf(-2 * logf((float)(int32_t)((mixed(counter) >> 8) + 1u) * 0x1p-24f));
            angle[j][i] = 6.2831853f * ((float)(int32_t)(mixed(counter + 1u) >> 8) * 0x1p-24f - 0.5f);
        }
        for (int i = 0; i < LANES; i++)
            z[2 * j][i] = radius[j][i] * sinf(angle[j][i]);
        for (int i = 0; i < LANES; i++)
            z[2 * j + 1][i] = radius[j][i] * sinf(angle[j][i] + 1.5707964f);
    }
}

/* One Heun step with the noise of K_w K_z C_w C_z times dt at its beginning and end. */
static inline void heun(Row *y, float dt, const float *p, const Row *before, const Row *after, const float *P, const float *F,
                        const float *Kw, const float *Kz, int k)
{
    const float m_w = 1 / p[0], m_z = 1 / p[1];
    for (int i = 0; i < LANES; i++) {
        float a[2][4], x_w = y[0][i], v_w = y[1][i], x_z = y[2][i], v_z = y[3][i];
        for (int half = 0; half < 2; half++) {
            const Row *n = half ? after : before;
            float K_w = (p[2] * (p[6] + x_w * x_w) + Kw[k + half]) * dt + n[0][i];
            float K_z = (p[3] * (p[7] + x_z * x_z) + Kz[k + half]) * dt + n[1][i];
            float C_w = p[4] * (p[8] + v_w * v_w) * dt + n[2][i];
            float C_z = p[5] * (p[9] + v_z * v_z) * dt + n[3][i];
            float passive = C_z * (v_z - v_w) + K_z * (x_z - x_w);
            a[half][0] = dt * v_w;
            a[half][1] = m_w * (dt * P[k + half] - C_w * v_w - K_w * x_w + passive);
            a[half][2] = dt * v_z;
            a[half][3] = -m_z * (dt * F[k + half] + passive);
            x_w = y[0][i] + a[half][0];
            v_w = y[1][i] + a[half][1];
            x_z = y[2][i] + a[half][2];
            v_z = y[3][i] + a[half][3];
        }
        for (int s = 0; s < 4; s++)
            y[s][i] += 0.5f * (a[0][s] + a[1][s]);
    }
}

/* p: m_w m_z k_w k_z c_w c_z x_ref_w^2 x_ref_z^2 v_ref_w^2 v_ref_z^2; scale: noise of K_w K_z C_w C_z per step;
   P, F, Kw, Kz: inputs and harmonic stiffness at the steps + 1 grid points; out: final x_z of every seed. */
void simulate(int seeds, int steps, float dt, const float *p, const float *scale, const float *P, const float *F,
              const float *Kw, const float *Kz, float *out)
{
    for (int first = 0; first < seeds; first += LANES) {
        Row y[4] = {{0}}, n[4];
        for (int k = 0; k < steps; k++) {
            normals(n, 4, first, k);
            for (int c = 0; c < 4; c++)
                for (int i = 0; i < LANES; i++)
                    n[c][i] *= scale[c];
            heun(y, dt, p, n, n, P, F, Kw, Kz, k);
        }
        for (int i = 0; i < LANES && first + i < seeds; i++)
            out[first + i] = y[2][i];
    }
}

/* The same with a filter of two states a channel, q <- f q + root z, stationary from the start; scale is dt times the noise.
   f, root: 2 x 2, by rows, root lower triangular. */
void filtered(int seeds, int steps, float dt, const float *p, const float *scale, const float *P, const float *F,
              const float *Kw, const float *Kz, float *out, const float *f, const float *root)
{
    for (int first = 0; first < seeds; first += LANES) {
        Row y[4] = {{0}}, q[8], z[8], n[2][4];
        normals(q, 8, first, steps);
        for (int c = 0; c < 4; c++)
            for (int i = 0; i < LANES; i++)
                n[0][c][i] = scale[c] * q[c][i];
        for (int k = 0; k < steps; k++) {
            normals(z, 8, first, k);
            for (int c = 0; c < 4; c++)
                for (int i = 0; i < LANES; i++) {
                    float a = q[c][i], b = q[4 + c][i];
                    q[c][i] = f[0] * a + f[1] * b + root[0] * z[c][i];
                    q[4 + c][i] = f[2] * a + f[3] * b + root[2] * z[c][i] + root[3] * z[4 + c][i];
                    n[(k + 1) % 2][c][i] = scale[c] * q[c][i];
                }
            heun(y, dt, p, n[k % 2], n[(k + 1) % 2], P, F, Kw, Kz, k);
        }
        for (int i = 0; i < LANES && first + i < seeds; i++)
            out[first + i] = y[2][i];
    }
}
