/* 3D MLS-MPM (Hu et al. 2018) of Tait water as a plain single-threaded C program: ``mpm_loop.c`` with a third axis.
 *
 * The same scheme, number for number, as the Taichi solver in sim/mpm; see ``mpm_loop.c`` for its parts and units. Arrays are per
 * particle: x, v [n][3], C [n][3][3] row-major with C[a][b] = dv_a/dx_b, J [n]. The whole grid is swept, as there.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { WALL = 1, GHOSTS = 2 * WALL + 1 };

typedef struct { float p[3], m; } Node; /* momentum, then velocity; mass */

typedef struct {
    int cells[3];
    float dx, gravity[3], friction;
    float mass, volume; /* of a particle at rest */
} Setting;

typedef struct { Node *node; int size[3], stride[3]; size_t nodes; } Grid;

static Grid make_grid(const Setting *s) {
    Grid grid;
    for (int a = 0; a < 3; a++) grid.size[a] = s->cells[a] + GHOSTS;
    grid.stride[2] = 1;
    grid.stride[1] = grid.size[2];
    grid.stride[0] = grid.size[1] * grid.size[2];
    grid.nodes = (size_t)grid.stride[0] * grid.size[0];
    grid.node = malloc(sizeof(Node) * grid.nodes);
    return grid;
}

static inline void weights(float f, float w[3]) {
    w[0] = 0.5f * (1.5f - f) * (1.5f - f);
    w[1] = 0.75f - (f - 1.0f) * (f - 1.0f);
    w[2] = 0.5f * (f - 0.5f) * (f - 0.5f);
}

static inline Node *first_node(Grid grid, const float *x, float f[3]) {
    int base[3];
    for (int a = 0; a < 3; a++) {
        base[a] = (int)(x[a] - 0.5f);
        f[a] = x[a] - base[a];
    }
    return grid.node + base[0] * grid.stride[0] + base[1] * grid.stride[1] + base[2];
}

/* P2G: m_i += w m, p_i += w [m v + A (x_i - x_p)]; A [3][3] per cell, so that A times an offset in cells is a momentum. */
static inline void scatter(Grid grid, const float *x, const float *v, const float A[9], float mass) {
    float f[3], wx[3], wy[3], wz[3];
    Node *corner = first_node(grid, x, f);
    weights(f[0], wx);
    weights(f[1], wy);
    weights(f[2], wz);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            Node *row = corner + i * grid.stride[0] + j * grid.stride[1];
            float wij = wx[i] * wy[j], rx = i - f[0], ry = j - f[1];
            for (int k = 0; k < 3; k++) {
                float w = wij * wz[k], rz = k - f[2];
                for (int a = 0; a < 3; a++) row[k].p[a] += w * (mass * v[a] + A[3 * a] * rx + A[3 * a + 1] * ry + A[3 * a + 2] * rz);
                row[k].m += w * mass;
            }
        }
}

/* Walls stop what moves into them and take Coulomb friction from the tangential part. */
static inline void contact(float v[3], const int at[3], const Setting *s) {
    for (int a = 0; a < 3; a++) {
        float normal = v[a];
        if ((at[a] == WALL && normal < 0.0f) || (at[a] == WALL + s->cells[a] && normal > 0.0f)) {
            v[a] = 0.0f;
            float speed = sqrtf(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
            float kept = fmaxf(0.0f, 1.0f - s->friction * fabsf(normal) / fmaxf(speed, 1e-12f));
            for (int d = 0; d < 3; d++) v[d] *= kept;
        }
    }
}

/* What particles gave to a ghost node goes to the wall node ``at`` and the next one inwards, which make up its velocity. */
static inline void fold(Node *ghost, int stride, const int at[3], const Setting *s, float dt) {
    Node *held = ghost + stride, *inner = ghost + 2 * stride;
    float m = ghost->m, m0 = held->m, m1 = inner->m, free[3], fixed[3], fall[3], stopped[3];
    if (m <= 0.0f) return;
    float det = (m0 + 4.0f * m) * (m1 + m) - 4.0f * m * m;
    for (int a = 0; a < 3; a++) {
        float r0 = held->p[a] + 2.0f * ghost->p[a], r1 = inner->p[a] - ghost->p[a];
        free[a] = ((m1 + m) * r0 + 2.0f * m * r1) / det;
        fixed[a] = ((m0 + 4.0f * m) * r1 + 2.0f * m * r0) / det;
        stopped[a] = fall[a] = free[a] + dt * s->gravity[a];
    }
    contact(stopped, at, s);
    for (int a = 0; a < 3; a++) {
        held->p[a] = m0 * free[a];
        inner->p[a] = m1 * (fixed[a] + 2.0f * m / (m1 + m) * (stopped[a] - fall[a]));
    }
}

/* Ghost nodes behind the walls continue the velocity linearly: v(-1) = 2 v(0) - v(1). stride: to the next node inwards. */
static inline void extrapolate(Node *ghost, int stride) {
    const Node *held = ghost + stride, *inner = ghost + 2 * stride;
    int known = inner->m > 0.0f;
    for (int a = 0; a < 3; a++) ghost->p[a] = known ? 2.0f * held->p[a] - inner->p[a] : held->p[a];
    ghost->m = held->m;
}

/* ``fold`` (before the nodes' update) or ``extrapolate`` (after it) at all walls. */
static void ghosts(Grid grid, const Setting *s, float dt, int before) {
    for (int a = 0; a < 3; a++) {
        int b = (a + 1) % 3, c = (a + 2) % 3;
        for (int side = 0; side < 2; side++) {
            int stride = side ? -grid.stride[a] : grid.stride[a], at[3];
            Node *face = grid.node + (side ? (grid.size[a] - 1) * grid.stride[a] : 0);
            at[a] = side ? WALL + s->cells[a] : WALL;
            for (at[b] = 0; at[b] < grid.size[b]; at[b]++)
                for (at[c] = 0; at[c] < grid.size[c]; at[c]++) {
                    Node *ghost = face + at[b] * grid.stride[b] + at[c] * grid.stride[c];
                    if (before) fold(ghost, stride, at, s, dt);
                    else extrapolate(ghost, stride);
                }
        }
    }
}

/* Node velocities: gravity, then walls. */
static void update_nodes(Grid grid, const Setting *s, float dt) {
    int at[3];
    Node *node = grid.node;
    for (at[0] = 0; at[0] < grid.size[0]; at[0]++)
        for (at[1] = 0; at[1] < grid.size[1]; at[1]++)
            for (at[2] = 0; at[2] < grid.size[2]; at[2]++, node++) {
                if (node->m <= 0.0f) continue;
                float inverse = 1.0f / node->m;
                for (int a = 0; a < 3; a++) node->p[a] = node->p[a] * inverse + dt * s->gravity[a];
                contact(node->p, at, s);
            }
}

/* G2P: v = sum w v_i, C = 4 / dx^2 sum w v_i (x_i - x_p)^T, x += dt v, held a hair inside the walls. */
static inline void gather(Grid grid, const Setting *s, float dt, float *x, float *v, float *C) {
    const float hair = 1e-4f;
    float f[3], wx[3], wy[3], wz[3], u[3] = {0, 0, 0}, D[9] = {0};
    const Node *corner = first_node(grid, x, f);
    weights(f[0], wx);
    weights(f[1], wy);
    weights(f[2], wz);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const Node *row = corner + i * grid.stride[0] + j * grid.stride[1];
            float wij = wx[i] * wy[j], rx = i - f[0], ry = j - f[1];
            for (int k = 0; k < 3; k++) {
                float w = wij * wz[k], rz = k - f[2];
                for (int a = 0; a < 3; a++) {
                    float part = w * row[k].p[a];
                    u[a] += part;
                    D[3 * a] += part * rx;
                    D[3 * a + 1] += part * ry;
                    D[3 * a + 2] += part * rz;
                }
            }
        }
    for (int a = 0; a < 9; a++) C[a] = 4.0f / s->dx * D[a];
    for (int a = 0; a < 3; a++) {
        float moved = x[a] + dt / s->dx * u[a], low = WALL + hair, high = WALL + s->cells[a] - hair;
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
void run_water_3d(int n, float *x, float *v, float *C, float *J, int substeps, float dt, const Setting *s, float stiffness) {
    Grid grid = make_grid(s);
    for (int step = 0; step < substeps; step++) {
        memset(grid.node, 0, sizeof(Node) * grid.nodes);
        for (int p = 0; p < n; p++) {
            const float *c = C + 9 * p;
            float A[9], j = J[p] *= exponential(dt * (c[0] + c[4] + c[8]));
            float square = 1.0f / (j * j), six = square * square * square;
            float push = dt * s->volume * 4.0f / s->dx * stiffness * (six - j), k = s->mass * s->dx;
            for (int a = 0; a < 9; a++) A[a] = k * c[a];
            for (int a = 0; a < 9; a += 4) A[a] += push;
            scatter(grid, x + 3 * p, v + 3 * p, A, s->mass);
        }
        ghosts(grid, s, dt, 1);
        update_nodes(grid, s, dt);
        ghosts(grid, s, dt, 0);
        for (int p = 0; p < n; p++) gather(grid, s, dt, x + 3 * p, v + 3 * p, C + 9 * p);
    }
    free(grid.node);
}
