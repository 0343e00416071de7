// Products in bfloat16 with float32 sums: part of Scan<T> (scan.hpp), for the instruction sets that
// define BF16.
//
// Operands are rounded to the nearest bfloat16, ties to even, where they are used. All is in tiles
// of 16 rows of 64 bytes:
//
//     weights      [16 outputs][32 inputs]
//     activations  [16 pairs of inputs][16 lanes]
//     sums         [16 outputs][16 lanes], float32
//
// With AMX a tile is a register. With AVX512-BF16 a row of sums is one, and a pair of weights is
// broadcast. Padding is 0. The sums of a lane do not depend on other lanes.

typedef uint16_t Half __attribute__((may_alias));
typedef uint32_t TwoHalves __attribute__((may_alias));
static constexpr int TILE_OUT = 16, TILE_IN = 32, TILE_SIZE = TILE_OUT * TILE_IN;
static constexpr int PAIRS_SIZE = TILE_SIZE / 2, SUMS_SIZE = TILE_OUT * 16;
static constexpr int INPUTS_AT_ONCE = 512;  // whose pairs are on the stack

static INLINE uint16_t to_half(float x) {
  uint32_t bits;
  __builtin_memcpy(&bits, &x, 4);
  if (x != x) return uint16_t(bits >> 16 | 64);
  return uint16_t((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
}
// `w(o, i)` is the weight of an output and an input.
template <class Fn>
static void pack_tiles(int out, int in, T* packed, const Fn& w) {
  Half* p = reinterpret_cast<Half*>(packed);
  for (int o = 0; o < out; o += TILE_OUT)
    for (int k = 0; k < in; k += TILE_IN)
      for (int r = 0; r < TILE_OUT; ++r)
        for (int c = 0; c < TILE_IN; ++c)
          *p++ = o + r < out && k + c < in ? to_half(w(o + r, k + c)) : uint16_t(0);
}

static INLINE __m512i two_rows(__m512 first, __m512 second) {
  return (__m512i)_mm512_cvtne2ps_pbh(second, first);
}
// Tiles of pairs of the units of x, [tile of units][vector of lanes].
template <int NV>
static INLINE void unit_pairs(const T* x, int units, TwoHalves* to) {
  alignas(64) static constexpr uint16_t ORDER[32] = {0, 16, 1, 17, 2,  18, 3,  19, 4,  20, 5,
                                                     21, 6, 22, 7, 23, 8,  24, 9,  25, 10, 26,
                                                     11, 27, 12, 28, 13, 29, 14, 30, 15, 31};
  const __m512i order = _mm512_load_si512(ORDER);
  constexpr int W = NV * VW;
  for (int u = 0; u < up(units, TILE_IN); u += 2)
    for (int v = 0; v < NV; ++v) {
      const float* at = x + int64_t(u) * W + v * VW;
      const __m512 none = _mm512_setzero_ps();
      const __m512i both = two_rows(u < units ? _mm512_loadu_ps(at) : none,
                                    u + 1 < units ? _mm512_loadu_ps(at + W) : none);
      _mm512_store_si512(to + (u / TILE_IN * NV + v) * PAIRS_SIZE + u % TILE_IN * 8,
                         _mm512_permutexvar_epi16(order, both));
    }
}

// ROWS x COLUMNS tiles of sums, each the sum of `tiles` products of a tile of a and one of b. The
// tiles of a of one sum follow each other, and those of the second row begin `a_row` later. The
// tiles of b are `b_tile` apart, and those of the second column begin `b_column` later. `top` and
// `below` are the rows of the sums.
#if BF16_AMX
// The tile registers of a thread: 0-3 sums, 4-5 rows, 6-7 columns.
struct Tiles {
  Tiles() {
    alignas(64) struct {
      uint8_t palette = 1, start = 0, reserved[14] = {};
      uint16_t bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
      uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
    } shape;
    asm volatile("" ::: "memory");
    _tile_loadconfig(&shape);
  }
  ~Tiles() { _tile_release(); }
};
template <int ROWS, int COLUMNS>
static INLINE void tile_sums(int tiles, const Half* a, int64_t a_row, const TwoHalves* b,
                             int64_t b_tile, int64_t b_column, bool add, T* top, T* below) {
  asm volatile("" ::: "memory");  // the instructions read what has been stored
  if (add) {
    _tile_loadd(0, top, 64);
    if (COLUMNS > 1) _tile_loadd(1, top + SUMS_SIZE, 64);
    if (ROWS > 1) _tile_loadd(2, below, 64);
    if (ROWS > 1 && COLUMNS > 1) _tile_loadd(3, below + SUMS_SIZE, 64);
  } else {
    _tile_zero(0);
    _tile_zero(1);
    _tile_zero(2);
    _tile_zero(3);
  }
  for (int k = 0; k < tiles; ++k) {
    _tile_loadd(4, a, 64);
    _tile_loadd(6, b, 64);
    _tile_dpbf16ps(0, 4, 6);
    if (ROWS > 1) {
      _tile_loadd(5, a + a_row, 64);
      _tile_dpbf16ps(2, 5, 6);
    }
    if (COLUMNS > 1) {
      _tile_loadd(7, b + b_column, 64);
      _tile_dpbf16ps(1, 4, 7);
    }
    if (ROWS > 1 && COLUMNS > 1) _tile_dpbf16ps(3, 5, 7);
    a += TILE_SIZE, b += b_tile;
  }
  _tile_stored(0, top, 64);
  if (COLUMNS > 1) _tile_stored(1, top + SUMS_SIZE, 64);
  if (ROWS > 1) _tile_stored(2, below, 64);
  if (ROWS > 1 && COLUMNS > 1) _tile_stored(3, below + SUMS_SIZE, 64);
}
#else
template <int ROWS, int COLUMNS>
static INLINE void tile_sums(int tiles, const Half* a, int64_t a_row, const TwoHalves* b,
                             int64_t b_tile, int64_t b_column, bool add, T* top, T* below) {
  constexpr int R = 8;  // rows at a time
  for (int r = 0; r < ROWS * TILE_OUT; r += R) {
    const TwoHalves* w =
        reinterpret_cast<const TwoHalves*>(a + r / TILE_OUT * a_row) + r % TILE_OUT * 16;
    T* to = (r < TILE_OUT ? top : below) + r % TILE_OUT * 16;
    __m512 acc[R][COLUMNS];
    for (int q = 0; q < R; ++q)
      for (int v = 0; v < COLUMNS; ++v)
        acc[q][v] = add ? _mm512_load_ps(to + v * SUMS_SIZE + q * 16) : _mm512_setzero_ps();
    for (int k = 0; k < tiles; ++k)
      for (int pair = 0; pair < 16; ++pair) {
        const TwoHalves* from = b + k * b_tile + pair * 16;
        __m512bh x[COLUMNS];
        for (int v = 0; v < COLUMNS; ++v)
          x[v] = (__m512bh)_mm512_load_si512(from + v * b_column);
        for (int q = 0; q < R; ++q) {
          const __m512bh each =
              (__m512bh)_mm512_set1_epi32(int(w[k * (TILE_SIZE / 2) + q * 16 + pair]));
          for (int v = 0; v < COLUMNS; ++v) acc[q][v] = _mm512_dpbf16_ps(acc[q][v], each, x[v]);
        }
      }
    for (int q = 0; q < R; ++q)
      for (int v = 0; v < COLUMNS; ++v) _mm512_store_ps(to + v * SUMS_SIZE + q * 16, acc[q][v]);
  }
}
#endif

// y[o] = (accumulate ? y[o] : bias[o]) + sum over k of w[o][k] x[k], for NV vectors of lanes.
template <int NV, bool ACCUMULATE, class Finish>
static INLINE void half_product(const T* packed, const T* bias, int out, int in, const T* x, T* y,
                                const Finish& finish) {
  constexpr int W = NV * VW;
  alignas(64) TwoHalves pairs[INPUTS_AT_ONCE / 2 * W];
  alignas(64) T sums[2 * NV * SUMS_SIZE];
  T* below = sums + NV * SUMS_SIZE;
  const int64_t a_row = int64_t(up(in, TILE_IN)) * TILE_OUT;
  for (int first = 0; first < in; first += INPUTS_AT_ONCE) {
    const int some = in - first < INPUTS_AT_ONCE ? in - first : INPUTS_AT_ONCE;
    const bool last = first + some == in;
    const int tiles = up(some, TILE_IN) / TILE_IN;
    unit_pairs<NV>(x + int64_t(first) * W, some, pairs);
    const Half* w = reinterpret_cast<const Half*>(packed) + first * TILE_OUT;
    for (int o = 0; o < out; o += 2 * TILE_OUT, w += 2 * a_row) {
      const int rows = out - o < 2 * TILE_OUT ? out - o : 2 * TILE_OUT;
      const int64_t at = int64_t(o) * W;
      for (int64_t i = 0; i < int64_t(rows) * W; i += VW) finish.soon(at + i);
      constexpr int B = NV * PAIRS_SIZE;
      if (rows > TILE_OUT)
        tile_sums<2, NV>(tiles, w, a_row, pairs, B, PAIRS_SIZE, false, sums, below);
      else
        tile_sums<1, NV>(tiles, w, a_row, pairs, B, PAIRS_SIZE, false, sums, below);
      for (int r = 0; r < rows; ++r)
        for (int v = 0; v < NV; ++v) {
          const int64_t i = at + r * W + v * VW;
          V acc = load<T>(sums + (r / TILE_OUT * NV + v) * SUMS_SIZE + r % TILE_OUT * 16);
          if (ACCUMULATE || first)
            acc += load<T>(y + i);
          else if (bias)
            acc += splat(bias[o + r]);
          store<T>(y + i, last ? finish(acc, i) : acc);
        }
    }
  }
}

// Gradients of weights: tiles of [16 outputs][32 lanes] times [16 pairs of lanes][16 inputs].
static INLINE __m512i lanes_of(const T* x, int W, __mmask32 in_use) {
  const __m512 second = W > VW ? _mm512_loadu_ps(x + VW) : _mm512_setzero_ps();
  return _mm512_maskz_mov_epi16(in_use, two_rows(_mm512_loadu_ps(x), second));
}
// Of 32 bits: row k becomes column k.
static INLINE void transpose_16_by_16(__m512i (&r)[16]) {
  __m512i t[16];
  for (int i = 0; i < 16; i += 2) {
    t[i] = _mm512_unpacklo_epi32(r[i], r[i + 1]);
    t[i + 1] = _mm512_unpackhi_epi32(r[i], r[i + 1]);
  }
  for (int i = 0; i < 16; i += 4)
    for (int k = 0; k < 2; ++k) {
      r[i + 2 * k] = _mm512_unpacklo_epi64(t[i + k], t[i + 2 + k]);
      r[i + 2 * k + 1] = _mm512_unpackhi_epi64(t[i + k], t[i + 2 + k]);
    }
  for (int half = 0; half < 16; half += 8)
    for (int k = 0; k < 4; ++k) {
      t[half + k] = _mm512_shuffle_i32x4(r[half + k], r[half + 4 + k], 0x88);
      t[half + 4 + k] = _mm512_shuffle_i32x4(r[half + k], r[half + 4 + k], 0xdd);
    }
  for (int k = 0; k < 8; ++k) {
    r[k] = _mm512_shuffle_i32x4(t[k], t[8 + k], 0x88);
    r[8 + k] = _mm512_shuffle_i32x4(t[k], t[8 + k], 0xdd);
  }
}
static void add_half_pairs(const Matrix& m, int pairs, int W, int lanes, const T* const* to_out,
                           const T* const* x, T* sum, T* scratch) {
  const int out = up(m.out, TILE_OUT), in = up(m.in, 16);
  const __mmask32 in_use = lanes < 32 ? (__mmask32(1) << lanes) - 1 : ~__mmask32(0);
  const int64_t row = int64_t(pairs) * TILE_SIZE, column = row / 2;
  Half* a = reinterpret_cast<Half*>(scratch);
  TwoHalves* b = reinterpret_cast<TwoHalves*>(scratch) + out / 16 * column;
  for (int e = 0; e < pairs; ++e) {
    for (int o = 0; o < out; ++o)
      _mm512_store_si512(a + o / 16 * row + e * TILE_SIZE + o % 16 * TILE_IN,
                         o < m.out ? lanes_of(to_out[e] + int64_t(o) * W, W, in_use)
                                   : _mm512_setzero_si512());
    for (int i = 0; i < in; i += 16) {
      __m512i r[16];
      for (int k = 0; k < 16; ++k)
        r[k] = i + k < m.in ? lanes_of(x[e] + int64_t(i + k) * W, W, in_use)
                            : _mm512_setzero_si512();
      transpose_16_by_16(r);
      for (int k = 0; k < 16; ++k)
        _mm512_store_si512(b + i / 16 * column + e * PAIRS_SIZE + k * 16, r[k]);
    }
  }
  for (int o = 0; o < out; o += 2 * TILE_OUT)
    for (int i = 0; i < in; i += 32) {
      const Half* rows = a + o / 16 * row;
      const TwoHalves* columns = b + i / 16 * column;
      T* top = sum + int64_t(o) * in + i * 16;
      auto block = [&](auto r, auto c) {
        tile_sums<r(), c()>(pairs, rows, row, columns, PAIRS_SIZE, column, true, top,
                            top + 16 * in);
      };
      const bool two = o + TILE_OUT < out;
      if (i + 16 < in)
        two ? block(Count<2>{}, Count<2>{}) : block(Count<1>{}, Count<2>{});
      else
        two ? block(Count<2>{}, Count<1>{}) : block(Count<1>{}, Count<1>{});
    }
}
// Where the sum of an output and an input is, in `in` padded inputs.
static INLINE int64_t sum_place(int o, int i, int in) {
  return int64_t(o / 16) * 16 * in + i / 16 * SUMS_SIZE + o % 16 * 16 + i % 16;
}
