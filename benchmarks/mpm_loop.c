/* 2D MLS-MPM (Hu et al. 2018) as a plain single-threaded C program: the yardstick for the Taichi solver in sim/mpm.
 *
 * The same scheme, number for number: quadratic B-splines, APIC, separating frictional walls on grid nodes with one line of
 * ghost nodes behind them, Tait water (J only) and Drucker-Prager sand on Hencky strain carried as b - I. A substep clears the
 * grid, scatters, updates the nodes, gathers; all stencil loops have constant bounds. float32 throughout.
 *
 * Units: positions in cells counted from the ghost corner (walls at node WALL and WALL + cells); everything else as the caller
 * has it. Arrays are per particle: x, v [n][2], C [n][2][2] row-major with C[a][b] = dv_a/dx_b, J [n], b [n][3] (xx, yy, xy),
 * gain [n]. Build: cc -O3 -march=native -ffast-math (the Taichi side has fast_math on).
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { WALL = 1, GHOSTS = 2 * WALL + 1 };

typedef struct { float p[2], m; } Node; /* momentum, then velocity; mass */

typedef struct {
    int cells[2];
    float dx, gravity[2], friction;
    float mass, volume; /* of a particle at rest */
} Setting;

typedef struct { Node *node; int pitch, rows; } Grid;

static Grid make_grid(const Setting *s) {
    Grid grid = {NULL, s->cells[1] + GHOSTS, s->cells[0] + GHOSTS};
    grid.node = malloc(sizeof(Node) * grid.pitch * grid.rows);
    return grid;
}

static inline void weights(float f, float w[3]) {
    w[0] = 0.5f * (1.5f - f) * (1.5f - f);
    w[1] = 0.75f - (f - 1.0f) * (f - 1.0f);
    w[2] = 0.5f * (f - 0.5f) * (f - 0.5f);
}

/* P2G: m_i += w m, p_i += w [m v + A (x_i - x_p)]; A [2][2] per cell, so that A times an offset in cells is a momentum. */
static inline void scatter(Grid grid, const float *x, const float *v, const float A[4], float mass) {
    int bx = (int)(x[0] - 0.5f), by = (int)(x[1] - 0.5f);
    float fx = x[0] - bx, fy = x[1] - by, wx[3], wy[3];
    weights(fx, wx);
    weights(fy, wy);
    for (int i = 0; i < 3; i++) {
        Node *row = grid.node + (bx + i) * grid.pitch + by;
        for (int j = 0; j < 3; j++) {
            float w = wx[i] * wy[j], rx = i - fx, ry = j - fy;
            row[j].p[0] += w * (mass * v[0] + A[0] * rx + A[1] * ry);
            row[j].p[1] += w * (mass * v[1] + A[2] * rx + A[3] * ry);
            row[j].m += w * mass;
        }
    }
}

/* Walls stop what moves into them and take Coulomb friction from the tangential part. */
static inline void contact(float v[2], int i, int j, const Setting *s) {
    int at[2] = {i, j}, high[2] = {WALL + s->cells[0], WALL + s->cells[1]};
    for (int a = 0; a < 2; a++) {
        float normal = v[a];
        if ((at[a] == WALL && normal < 0.0f) || (at[a] == high[a] && normal > 0.0f)) {
            v[a] = 0.0f;
            float tangent = v[1 - a], lost = s->friction * fabsf(normal);
            v[1 - a] = fabsf(tangent) <= lost ? 0.0f : tangent - copysignf(lost, tangent);
        }
    }
}

/* What particles gave to a ghost node goes to the wall node (i, j) and the next one inwards, which make up its velocity. */
static inline void fold(Node *ghost, int stride, int i, int j, const Setting *s, float dt) {
    Node *held = ghost + stride, *inner = ghost + 2 * stride;
    float m = ghost->m, m0 = held->m, m1 = inner->m, free[2], fixed[2], fall[2], stopped[2];
    if (m <= 0.0f) return;
    float det = (m0 + 4.0f * m) * (m1 + m) - 4.0f * m * m;
    for (int a = 0; a < 2; a++) {
        float r0 = held->p[a] + 2.0f * ghost->p[a], r1 = inner->p[a] - ghost->p[a];
        free[a] = ((m1 + m) * r0 + 2.0f * m * r1) / det;
        fixed[a] = ((m0 + 4.0f * m) * r1 + 2.0f * m * r0) / det;
        stopped[a] = fall[a] = free[a] + dt * s->gravity[a];
    }
    contact(stopped, i, j, s);
    for (int a = 0; a < 2; a++) {
        held->p[a] = m0 * free[a];
        inner->p[a] = m1 * (fixed[a] + 2.0f * m / (m1 + m) * (stopped[a] - fall[a]));
    }
}

static void fold_ghosts(Grid grid, const Setting *s, float dt) {
    int last = grid.rows - 1, end = grid.pitch - 1;
    for (int j = 0; j <= end; j++) {
        fold(grid.node + j, grid.pitch, WALL, j, s, dt);
        fold(grid.node + last * grid.pitch + j, -grid.pitch, WALL + s->cells[0], j, s, dt);
    }
    for (int i = 0; i <= last; i++) {
        fold(grid.node + i * grid.pitch, 1, i, WALL, s, dt);
        fold(grid.node + i * grid.pitch + end, -1, i, WALL + s->cells[1], s, dt);
    }
}

/* Node velocities: gravity, then walls. */
static void update_nodes(Grid grid, const Setting *s, float dt) {
    for (int i = 0; i < grid.rows; i++)
        for (int j = 0; j < grid.pitch; j++) {
            Node *c = grid.node + i * grid.pitch + j;
            if (c->m <= 0.0f) continue;
            float inverse = 1.0f / c->m;
            c->p[0] = c->p[0] * inverse + dt * s->gravity[0];
            c->p[1] = c->p[1] * inverse + dt * s->gravity[1];
            contact(c->p, i, j, s);
        }
}

/* Ghost nodes behind the walls continue the velocity linearly: v(-1) = 2 v(0) - v(1). stride: to the next node inwards. */
static inline void extrapolate(Node *ghost, int stride) {
    const Node *held = ghost + stride, *inner = ghost + 2 * stride;
    int known = inner->m > 0.0f;
    for (int a = 0; a < 2; a++) ghost->p[a] = known ? 2.0f * held->p[a] - inner->p[a] : held->p[a];
    ghost->m = held->m;
}

static void fill_ghosts(Grid grid) {
    int last = grid.rows - 1, end = grid.pitch - 1;
    for (int j = 0; j <= end; j++) {
        extrapolate(grid.node + j, grid.pitch);
        extrapolate(grid.node + last * grid.pitch + j, -grid.pitch);
    }
    for (int i = 0; i <= last; i++) {
        extrapolate(grid.node + i * grid.pitch, 1);
        extrapolate(grid.node + i * grid.pitch + end, -1);
    }
}

/* G2P: v = sum w v_i, C = 4 / dx^2 sum w v_i (x_i - x_p)^T, x += dt v, held a hair inside the walls. */
static inline void gather(Grid grid, const Setting *s, float dt, float *x, float *v, float *C) {
    const float hair = 1e-4f;
    int bx = (int)(x[0] - 0.5f), by = (int)(x[1] - 0.5f), cells[2] = {s->cells[0], s->cells[1]};
    float fx = x[0] - bx, fy = x[1] - by, wx[3], wy[3];
    weights(fx, wx);
    weights(fy, wy);
    float u[2] = {0, 0}, D[4] = {0, 0, 0, 0};
    for (int i = 0; i < 3; i++) {
        const Node *row = grid.node + (bx + i) * grid.pitch + by;
        for (int j = 0; j < 3; j++) {
            float w = wx[i] * wy[j], rx = i - fx, ry = j - fy;
            float ux = w * row[j].p[0], uy = w * row[j].p[1];
            u[0] += ux;
            u[1] += uy;
            D[0] += ux * rx;
            D[1] += ux * ry;
            D[2] += uy * rx;
            D[3] += uy * ry;
        }
    }
    for (int a = 0; a < 4; a++) C[a] = 4.0f / s->dx * D[a];
    for (int a = 0; a < 2; a++) {
        float moved = x[a] + dt / s->dx * u[a], low = WALL + hair, high = WALL + cells[a] - hair;
        if (moved < low) moved = low, u[a] = 0.0f;
        if (moved > high) moved = high, u[a] = 0.0f;
        x[a] = moved;
        v[a] = u[a];
    }
}

/* exp(g) to g^5 / 720; nothing of a volume that changes too much in a step. */
static float exponential(float g) {
    const float even = 12.0f + g * g;
    return fabsf(g) < 0.5f ? (even + 6.0f * g) / (even - 6.0f * g) : 0.0f;
}

/* Water: p = stiffness (J^-7 - 1), stiffness = rho0 c^2 / 7; tau = -J p I; J <- J exp(dt tr C). */
void run_water(int n, float *x, float *v, float *C, float *J, int substeps, float dt, const Setting *s, float stiffness) {
    Grid grid = make_grid(s);
    for (int step = 0; step < substeps; step++) {
        memset(grid.node, 0, sizeof(Node) * grid.pitch * grid.rows);
        for (int p = 0; p < n; p++) {
            const float *c = C + 4 * p;
            float j = J[p] *= exponential(dt * (c[0] + c[3]));
            float square = 1.0f / (j * j), six = square * square * square;
            float push = dt * s->volume * 4.0f / s->dx * stiffness * (six - j), k = s->mass * s->dx;
            float A[4] = {k * c[0] + push, k * c[1], k * c[2], k * c[3] + push};
            scatter(grid, x + 2 * p, v + 2 * p, A, s->mass);
        }
        fold_ghosts(grid, s, dt);
        update_nodes(grid, s, dt);
        fill_ghosts(grid);
        for (int p = 0; p < n; p++) gather(grid, s, dt, x + 2 * p, v + 2 * p, C + 4 * p);
    }
    free(grid.node);
}

/* Sand: trial b = (I + G) b (I + G)^T with G = dt C, kept as b - I; Hencky strain e_i = log1p(beta_i) / 2 of its eigenvalues;
 * return to |dev e| + k tr e = 0 with volume correction (Klar et al. 2016; Tampubolon et al. 2017); tau (xx, yy, xy). */
static inline void sand_stress(float *b, float *gain, const float *C, float dt, float lambda, float mu, float k, float tau[3]) {
    float g0 = dt * C[0], g1 = dt * C[1], g2 = dt * C[2], g3 = dt * C[3];
    float u0 = g0 * b[0] + g1 * b[2], u1 = g0 * b[2] + g1 * b[1], u2 = g2 * b[0] + g3 * b[2], u3 = g2 * b[2] + g3 * b[1]; /* G B */
    float xx = b[0] + 2 * g0 + g0 * g0 + g1 * g1 + 2 * u0 + u0 * g0 + u1 * g1;
    float yy = b[1] + 2 * g3 + g2 * g2 + g3 * g3 + 2 * u3 + u2 * g2 + u3 * g3;
    float xy = b[2] + g1 + g2 + g0 * g2 + g1 * g3 + u1 + u2 + u0 * g2 + u1 * g3;
    float mean = 0.5f * (xx + yy), half = 0.5f * (xx - yy), r = sqrtf(half * half + xy * xy);
    float cosine = r > 1e-30f ? half / r : 1.0f, sine = r > 1e-30f ? xy / r : 0.0f;
    float e1 = 0.5f * log1pf(fmaxf(mean + r, -0.999999f)), e2 = 0.5f * log1pf(fmaxf(mean - r, -0.999999f));
    float trace = e1 + e2 + *gain, centre = 0.5f * trace, dev = 0.5f * (e1 - e2), size = sqrtf(2.0f) * dev;
    int moved = *gain != 0.0f;
    *gain = 0.0f;
    if (trace >= 0.0f) {
        *gain = trace;
        centre = dev = 0.0f;
        moved = 1;
    } else if (size + k * trace > 0.0f) {
        dev = -k * trace / sqrtf(2.0f);
        moved = 1;
    }
    float pressure = 2.0f * (mu + lambda) * centre, shear = 2.0f * mu * dev;
    tau[0] = pressure + shear * cosine;
    tau[1] = pressure - shear * cosine;
    tau[2] = shear * sine;
    if (moved) {
        float b1 = expm1f(2.0f * (centre + dev)), b2 = expm1f(2.0f * (centre - dev));
        mean = 0.5f * (b1 + b2);
        half = 0.5f * (b1 - b2);
        xx = mean + half * cosine;
        yy = mean - half * cosine;
        xy = half * sine;
    }
    b[0] = xx;
    b[1] = yy;
    b[2] = xy;
}

void run_sand(int n, float *x, float *v, float *C, float *b, float *gain, int substeps, float dt, const Setting *s, float lambda, float mu, float k) {
    Grid grid = make_grid(s);
    for (int step = 0; step < substeps; step++) {
        memset(grid.node, 0, sizeof(Node) * grid.pitch * grid.rows);
        for (int p = 0; p < n; p++) {
            const float *c = C + 4 * p;
            float tau[3], q = -dt * s->volume * 4.0f / s->dx, m = s->mass * s->dx;
            sand_stress(b + 3 * p, gain + p, c, dt, lambda, mu, k, tau);
            float A[4] = {m * c[0] + q * tau[0], m * c[1] + q * tau[2], m * c[2] + q * tau[2], m * c[3] + q * tau[1]};
            scatter(grid, x + 2 * p, v + 2 * p, A, s->mass);
        }
        fold_ghosts(grid, s, dt);
        update_nodes(grid, s, dt);
        fill_ghosts(grid);
        for (int p = 0; p < n; p++) gather(grid, s, dt, x + 2 * p, v + 2 * p, C + 4 * p);
    }
    free(grid.node);
}
