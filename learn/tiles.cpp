// A tile of rows through a whole MLP, forward and backward; learn/tiles.py builds it, checks every argument and says why it is done this way.
//
//   x0 = W0 [row's inputs] + b0    or, for the edges of a block,    x0 = P[receiver] + Q[sender] + W0 e
//   xk = Wk relu(x(k-1)) + bk      k = 1 .. layers
//   m  = LayerNorm(x_layers)       written, added to the row's own latent, or summed over each receiver's rows
//
// Rows are float32 or bfloat16 (T); weights arrive in float32 and are packed as T once a call; all sums are float32.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int LANES = 16, ROWS = 8;
#else
constexpr int LANES = 8, ROWS = 4;
#endif
#define UNROLL _Pragma("GCC unroll 8")
#define ALONE __attribute__((noinline)) static

constexpr int WIDE = 2 * LANES;  // a micro tile is ROWS x WIDE sums, held in registers
constexpr int TILE = 48;         // rows that go through the layers together: what they need stays in the first-level cache
constexpr int MOST = 8;          // layers after the first

typedef float vec __attribute__((vector_size(4 * LANES)));
typedef float loose __attribute__((vector_size(4 * LANES), aligned(4)));

struct bf16 {
  uint16_t bits;
};

inline vec load(const float* p) { return *(const loose*)p; }
inline void store(float* p, vec v) { *(loose*)p = v; }
inline vec all(float x) { return x - vec{}; }
inline vec positive(vec v) { return v < 0 ? vec{} : v; }  // a NaN stays one

inline float total(vec v) {
#if defined(__AVX512F__)
  return _mm512_reduce_add_ps((__m512)v);
#else
  float sum = 0;
  for (int lane = 0; lane < LANES; ++lane) sum += v[lane];
  return sum;
#endif
}

#if defined(__AVX512BF16__)
inline vec load(const bf16* p) {
  __m512i wide = _mm512_cvtepu16_epi32(_mm256_loadu_si256((const __m256i*)p));
  return (vec)_mm512_slli_epi32(wide, 16);
}
inline void store(bf16* p, vec v) { _mm256_storeu_si256((__m256i*)p, (__m256i)_mm512_cvtneps_pbh((__m512)v)); }
#endif

inline bf16 rounded(float x) {  // to nearest, ties to even; a NaN stays one
  uint32_t bits;
  memcpy(&bits, &x, 4);
  if ((bits & 0x7fffffff) > 0x7f800000) return {uint16_t(bits >> 16 | 64)};
  return {uint16_t((bits + 0x7fff + (bits >> 16 & 1)) >> 16)};
}
inline void put(float* p, float x) { *p = x; }
inline void put(bf16* p, float x) { *p = rounded(x); }

// Products add `depth` of the rows of a weight at a time: one float32, or a pair of bfloat16.
template <class T>
constexpr int DEPTH = 4 / sizeof(T);

template <class T>
int even(int depth) {
  return (depth + DEPTH<T> - 1) / DEPTH<T> * DEPTH<T>;
}

template <class T>
struct Buffer {
  explicit Buffer(size_t count) : at((T*)aligned_alloc(64, (count * sizeof(T) + 127) / 64 * 64)) {
    if (!at) abort();
    memset(at, 0, count * sizeof(T));
  }
  ~Buffer() { free(at); }
  Buffer(const Buffer&) = delete;
  T* at;
};

// weight(column, depth) = w[column * across + depth * down] -> panels of WIDE columns, each [depth / DEPTH][WIDE][DEPTH].
template <class T>
void pack(const float* w, int64_t across, int64_t down, int columns, int depth, T* packed) {
  for (int first = 0; first < columns; first += WIDE)
    for (int k = 0; k < even<T>(depth); k += DEPTH<T>)
      for (int column = first; column < first + WIDE; ++column)
        for (int part = 0; part < DEPTH<T>; ++part) put(packed++, k + part < depth ? w[column * across + (k + part) * down] : 0.f);
}

struct Sums {
  vec at[ROWS][2];
};

// A function of its own, so that the compiler spends the registers on it alone: sums += a[ROWS rows, `leading` apart][depth] . panel
inline void multiply(const float* a, int64_t leading, int64_t step, const float* panel, int64_t width, int depth, Sums& sums) {
  Sums own = sums;
  for (int k = 0; k < depth; ++k) {
    const vec left = load(panel + k * width), right = load(panel + k * width + LANES);
    UNROLL for (int row = 0; row < ROWS; ++row) {
      const vec x = all(a[row * leading + k * step]);
      own.at[row][0] += x * left;
      own.at[row][1] += x * right;
    }
  }
  sums = own;
}

#if defined(__AVX512BF16__)
inline void multiply(const bf16* a, int64_t leading, int64_t step, const bf16* panel, int64_t width, int depth, Sums& sums) {
  Sums own = sums;
  for (int k = 0; k < depth / 2; ++k) {
    const bf16* at = panel + 2 * k * width;
    const __m512bh left = (__m512bh)_mm512_loadu_si512(at), right = (__m512bh)_mm512_loadu_si512(at + WIDE);
    UNROLL for (int row = 0; row < ROWS; ++row) {
      int pair;
      memcpy(&pair, a + row * leading + 2 * k * step, 4);
      const __m512bh x = (__m512bh)_mm512_set1_epi32(pair);
      own.at[row][0] = (vec)_mm512_dpbf16_ps((__m512)own.at[row][0], x, left);
      own.at[row][1] = (vec)_mm512_dpbf16_ps((__m512)own.at[row][1], x, right);
    }
  }
  sums = own;
}
#endif

// begin(row, column, sums) fills, end(row, column, sums) takes a micro tile of a[rows][depth] . packed.
template <class T, class Begin, class End>
ALONE void product(const T* a, int64_t leading, const T* packed, int depth, int columns, int rows, Begin begin, End end) {
  depth = even<T>(depth);
  for (int column = 0; column < columns; column += WIDE, packed += (int64_t)depth * WIDE)
    for (int row = 0; row < rows; row += ROWS) {
      Sums sums;
      begin(row, column, sums);
      multiply(a + row * leading, leading, 1, packed, WIDE, depth, sums);
      end(row, column, sums);
    }
}

inline int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

}  // namespace

extern "C" {

struct Forward {
  int64_t first, last;          // rows
  int64_t latent, layers;       // width; layers after the first
  const float* inputs[2];       // of a row that is no edge of a block: float32 [rows, width] each, side by side
  int64_t widths[2];            // 0: there is no such part
  void* edges;                  // T [rows, latent]: e of a block's edges, or where an encoder writes
  void* updated;                // T [rows, latent]: e + m (may be e), or null
  const void* table;            // T [particles, 2, latent]: P, Q; null: no edges of a block
  const int32_t *receiver, *sender;
  const float* weight;          // W0 [latent, inputs], rows `stride` apart
  int64_t stride;
  const float* bias;            // b0; null with a table, which holds it
  const float *weights[MOST], *biases[MOST], *gamma, *beta;
  float epsilon;
  float* sums;                  // [particles, latent], or null; rows of the receivers from `from` to `to` are written
  int64_t from, to;
  float* nodes;                 // [rows, latent], or null: m is added to what is there (`residual`) or replaces it
  int64_t residual;
  void* hidden[MOST];           // T [rows, latent] each: relu(x0), relu(x1), ...; null: they are not kept
  void* z;                      // T [rows, latent]: x_layers
  float *mean, *rstd;           // [rows]
};

struct Backward {
  int64_t first, last, latent, layers;
  const void *edges, *hidden[MOST], *z;
  const float *mean, *rstd, *gamma;
  const float* weight;
  int64_t stride;
  const float* weights[MOST];
  const int32_t* receiver;
  const float* grad_sums;       // [particles, latent]
  void* grad_edges;             // T [rows, latent]: of e + m, becomes e's
  void* grad_input;             // T [rows, latent]: of x0
  void* grad_table;             // T [particles, 2, latent]; P's rows of the receivers from `from` to `to` are written
  int64_t from, to;
  float *grad_weight, *grad_weights[MOST], *grad_biases[MOST], *grad_gamma, *grad_beta;  // added to; W0's is [latent, latent]
};
}

namespace {

template <class T>
void forward(const Forward& f) {
  const int latent = f.latent, layers = f.layers, depth = f.table ? latent : int(f.widths[0] + f.widths[1]);
  const int64_t wide = (even<T>(depth) > latent ? even<T>(depth) : latent) + LANES;  // apart from each other by no power of two
  Buffer<T> first((int64_t)even<T>(depth) * latent), rest((int64_t)layers * latent * latent), x(TILE * wide), y(TILE * wide);
  Buffer<float> z((int64_t)TILE * latent);
  pack(f.weight, f.stride, 1, latent, depth, first.at);
  for (int k = 0; k < layers; ++k) pack(f.weights[k], latent, 1, latent, latent, rest.at + (int64_t)k * latent * latent);
  const T* table = (const T*)f.table;
  if (f.sums) memset(f.sums + f.from * latent, 0, (f.to - f.from) * latent * sizeof(float));

  for (int64_t start = f.first; start < f.last; start += TILE) {
    const int rows = least(TILE, f.last - start);
    T *in = x.at, *out = y.at;
    const T* given = in;
    int64_t leading = wide;
    if (table && rows == TILE) {
      given = (const T*)f.edges + start * latent, leading = latent;
      const char* ahead = (const char*)(given + TILE * latent);
      const int64_t bytes = least(TILE, f.last - start - TILE) * latent * sizeof(T);
      for (int64_t at = 0; at < bytes; at += 64) __builtin_prefetch(ahead + at, 1, 2);
    } else if (table) {
      for (int row = 0; row < rows; ++row) memcpy(in + row * wide, (const T*)f.edges + (start + row) * latent, latent * sizeof(T));
    } else {
      for (int row = 0; row < rows; ++row) {
        T* to = in + row * wide;
        for (int part = 0; part < 2; ++part)
          for (int k = 0; k < f.widths[part]; ++k) put(to++, f.inputs[part][(start + row) * f.widths[part] + k]);
        if (depth < even<T>(depth)) put(to, 0.f);  // what an earlier tile left there may be no number
      }
    }
    auto begin_edges = [&](int row, int column, Sums& sums) {
      UNROLL for (int r = 0; r < ROWS; ++r) {
        const int64_t edge = start + least(row + r, rows - 1);
        const T *p = table + 2 * f.receiver[edge] * (int64_t)latent + column, *q = table + (2 * f.sender[edge] + 1) * (int64_t)latent + column;
        sums.at[r][0] = load(p) + load(q);
        sums.at[r][1] = load(p + LANES) + load(q + LANES);
      }
    };
    auto begin_bias = [](const float* bias) {
      return [bias](int, int column, Sums& sums) {
        UNROLL for (int r = 0; r < ROWS; ++r) sums.at[r][0] = load(bias + column), sums.at[r][1] = load(bias + column + LANES);
      };
    };
    auto keep = [&](T* to, void* kept) {
      return [=](int row, int column, Sums& sums) {
        UNROLL for (int r = 0; r < ROWS; ++r) {
          const vec left = positive(sums.at[r][0]), right = positive(sums.at[r][1]);
          T* at = to + (row + r) * wide + column;
          store(at, left), store(at + LANES, right);
          if (kept && row + r < rows) {
            at = (T*)kept + (start + row + r) * latent + column;
            store(at, left), store(at + LANES, right);
          }
        }
      };
    };
    if (table)
      product(given, leading, first.at, depth, latent, rows, begin_edges, keep(out, f.hidden[0]));
    else
      product(in, wide, first.at, depth, latent, rows, begin_bias(f.bias), keep(out, f.hidden[0]));
    for (int k = 1; k < layers; ++k) {
      T* swap = in;
      in = out, out = swap;
      product(in, wide, rest.at + (int64_t)(k - 1) * latent * latent, latent, latent, rows, begin_bias(f.biases[k - 1]), keep(out, f.hidden[k]));
    }
    product(out, wide, rest.at + (int64_t)(layers - 1) * latent * latent, latent, latent, rows, begin_bias(f.biases[layers - 1]),
            [&](int row, int column, Sums& sums) {
              UNROLL for (int r = 0; r < ROWS; ++r) {
                float* at = z.at + (row + r) * latent + column;
                store(at, sums.at[r][0]), store(at + LANES, sums.at[r][1]);
              }
            });

    for (int row = 0; row < rows; ++row) {
      const int64_t edge = start + row;
      const float* own = z.at + row * latent;
      vec sum = {}, square = {};
      for (int c = 0; c < latent; c += LANES) sum += load(own + c);
      const float mean = total(sum) / latent;
      for (int c = 0; c < latent; c += LANES) {
        const vec off = load(own + c) - mean;
        square += off * off;
      }
      const float rstd = 1 / std::sqrt(total(square) / latent + f.epsilon);
      if (f.mean) f.mean[edge] = mean, f.rstd[edge] = rstd;
      float* sums = f.sums ? f.sums + f.receiver[edge] * (int64_t)latent : nullptr;
      for (int c = 0; c < latent; c += LANES) {
        const vec value = load(own + c), message = (value - mean) * rstd * load(f.gamma + c) + load(f.beta + c);
        const int64_t at = edge * latent + c;
        if (f.z) store((T*)f.z + at, value);
        if (sums) store(sums + c, load(sums + c) + message);
        if (f.updated) store((T*)f.updated + at, table ? load((const T*)f.edges + at) + message : message);
        if (f.nodes) store(f.nodes + at, f.residual ? load(f.nodes + at) + message : message);
      }
    }
  }
}

// Rows as `multiply` reads them from above, DEPTH at a time: [rows / DEPTH][width][DEPTH].
inline const float* upright(const float* from, int64_t, int, int, float*) { return from; }
#if defined(__AVX512BF16__)
inline const bf16* upright(const bf16* from, int64_t leading, int rows, int width, bf16* to) {
  for (int row = 0; row < rows; row += 2)
    for (int c = 0; c < width; c += LANES) {
      const __m256i upper = _mm256_loadu_si256((const __m256i*)(from + row * leading + c));
      const __m256i lower = _mm256_loadu_si256((const __m256i*)(from + (row + 1) * leading + c));
      const __m512i pairs = _mm512_or_si512(_mm512_cvtepu16_epi32(upper), _mm512_slli_epi32(_mm512_cvtepu16_epi32(lower), 16));
      _mm512_storeu_si512(to + row * leading + 2 * c, pairs);
    }
  return to;
}
#endif

// grad[i][j] += sum over rows of g[row][i] x[row][j], both upright.
template <class T>
ALONE void outer(const T* g, const T* x, int64_t leading, int rows, int width, float* grad) {
  for (int j = 0; j < width; j += WIDE)
    for (int i = 0; i < width; i += ROWS) {
      Sums sums;  // of this tile alone: sums of sums round less
      UNROLL for (int r = 0; r < ROWS; ++r) sums.at[r][0] = sums.at[r][1] = vec{};
      multiply(g + i * DEPTH<T>, DEPTH<T>, leading, x + j * DEPTH<T>, leading, rows, sums);
      UNROLL for (int r = 0; r < ROWS; ++r) {
        float* at = grad + (int64_t)(i + r) * width + j;
        store(at, load(at) + sums.at[r][0]), store(at + LANES, load(at + LANES) + sums.at[r][1]);
      }
    }
}

// total[width] += part[width], which is cleared.
inline void gather(float* part, int width, float* total) {
  for (int c = 0; c < width; c += LANES) store(total + c, load(total + c) + load(part + c)), store(part + c, vec{});
}

template <class T>
void backward(const Backward& b) {
  const int latent = b.latent, layers = b.layers;
  const int64_t square = (int64_t)latent * latent, wide = latent + LANES;
  Buffer<T> first(square), rest(layers * square), g(TILE * wide), next(TILE * wide), x(TILE * wide), gs(TILE * wide), xs(TILE * wide);
  Buffer<float> sum(latent), part(latent), other(latent);
  pack(b.weight, 1, b.stride, latent, latent, first.at);
  for (int k = 0; k < layers; ++k) pack(b.weights[k], 1, latent, latent, latent, rest.at + k * square);
  for (int64_t particle = b.from; particle < b.to; ++particle) memset((T*)b.grad_table + 2 * particle * latent, 0, latent * sizeof(T));
  int64_t present = -1;

  for (int64_t start = b.first; start < b.last; start += TILE) {
    const int rows = least(TILE, b.last - start), full = (rows + ROWS - 1) / ROWS * ROWS;
    T *in = g.at, *out = next.at;
    for (int row = 0; row < rows; ++row) {
      const int64_t edge = start + row;
      const float mean = b.mean[edge], rstd = b.rstd[edge], *coming = b.grad_sums + b.receiver[edge] * (int64_t)latent;
      vec plain = {}, along = {};
      for (int c = 0; c < latent; c += LANES) {
        const vec gradient = load(coming + c) + load((const T*)b.grad_edges + edge * latent + c);
        const vec normal = (load((const T*)b.z + edge * latent + c) - mean) * rstd, scaled = gradient * load(b.gamma + c);
        store(part.at + c, load(part.at + c) + gradient);
        store(other.at + c, load(other.at + c) + gradient * normal);
        plain += scaled, along += scaled * normal;
      }
      const float shift = total(plain) / latent, tilt = total(along) / latent;
      for (int c = 0; c < latent; c += LANES) {
        const vec gradient = load(coming + c) + load((const T*)b.grad_edges + edge * latent + c);
        const vec normal = (load((const T*)b.z + edge * latent + c) - mean) * rstd;
        store(in + row * wide + c, rstd * (gradient * load(b.gamma + c) - shift - normal * tilt));
      }
    }
    gather(part.at, latent, b.grad_beta);
    gather(other.at, latent, b.grad_gamma);
    if (rows < full) {  // rows that are none add nothing
      memset(in + rows * wide, 0, (full - rows) * wide * sizeof(T));
      memset(x.at + rows * wide, 0, (full - rows) * wide * sizeof(T));
    }

    for (int k = layers; k >= 0; --k) {
      const T* given = k ? (const T*)b.hidden[k - 1] : (const T*)b.edges;
      for (int row = 0; row < rows; ++row) memcpy(x.at + row * wide, given + (start + row) * latent, latent * sizeof(T));
      outer(upright(in, wide, full, latent, gs.at), upright(x.at, wide, full, latent, xs.at), wide, full, latent,
            k ? b.grad_weights[k - 1] : b.grad_weight);
      if (k) {
        for (int row = 0; row < rows; ++row)
          for (int c = 0; c < latent; c += LANES) store(part.at + c, load(part.at + c) + load(in + row * wide + c));
        gather(part.at, latent, b.grad_biases[k - 1]);
      }
      auto begin = [](int, int, Sums& sums) {
        UNROLL for (int r = 0; r < ROWS; ++r) sums.at[r][0] = sums.at[r][1] = vec{};
      };
      if (k) {
        product(in, wide, rest.at + (k - 1) * square, latent, latent, full, begin, [&](int row, int column, Sums& sums) {
          UNROLL for (int r = 0; r < ROWS; ++r)
            UNROLL for (int half = 0; half < 2; ++half) {
              const int64_t at = (row + r) * wide + column + half * LANES;
              const vec active = load(x.at + at);
              store(out + at, active > 0 ? sums.at[r][half] : vec{});
            }
        });
        T* swap = in;
        in = out, out = swap;
      } else {
        product(in, wide, first.at, latent, latent, full, begin, [&](int row, int column, Sums& sums) {
          UNROLL for (int r = 0; r < ROWS; ++r)
            UNROLL for (int half = 0; half < 2; ++half) {
              if (row + r >= rows) continue;
              T* at = (T*)b.grad_edges + (start + row + r) * latent + column + half * LANES;
              store(at, load((const T*)at) + sums.at[r][half]);
            }
        });
      }
    }
    for (int row = 0; row < rows; ++row) {
      const int64_t edge = start + row, particle = b.receiver[edge];
      memcpy((T*)b.grad_input + edge * latent, in + row * wide, latent * sizeof(T));
      if (particle != present) {
        if (present >= 0)
          for (int c = 0; c < latent; c += LANES) store((T*)b.grad_table + 2 * present * latent + c, load(sum.at + c));
        memset(sum.at, 0, latent * sizeof(float));
        present = particle;
      }
      for (int c = 0; c < latent; c += LANES) store(sum.at + c, load(sum.at + c) + load(in + row * wide + c));
    }
  }
  if (present >= 0)
    for (int c = 0; c < latent; c += LANES) store((T*)b.grad_table + 2 * present * latent + c, load(sum.at + c));
}

// Every call's rows on a thread of its own.
template <class Call>
void each(const Call* calls, int64_t count, void (*work)(const Call&)) {
#pragma omp parallel for num_threads(count) schedule(static, 1)
  for (int64_t call = 0; call < count; ++call) work(calls[call]);
}

}  // namespace

extern "C" {

void forward_f32(const Forward* calls, int64_t count) { each(calls, count, forward<float>); }
void backward_f32(const Backward* calls, int64_t count) { each(calls, count, backward<float>); }
int64_t width() { return WIDE; }
#if defined(__AVX512BF16__)
int64_t multiplies_bf16() { return 1; }
void forward_bf16(const Forward* calls, int64_t count) { each(calls, count, forward<bf16>); }
void backward_bf16(const Backward* calls, int64_t count) { each(calls, count, backward<bf16>); }
#else
int64_t multiplies_bf16() { return 0; }
void forward_bf16(const Forward*, int64_t) { abort(); }
void backward_bf16(const Backward*, int64_t) { abort(); }
#endif
}
