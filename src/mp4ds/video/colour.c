// RGB of luma and halved chroma, in the integers of spec/index.md, "Colours"; colour.py does the
// same where this was not compiled. Plain C, in loops that compilers make SIMD of.

#include <stddef.h>
#include <stdint.h>

#ifdef PROCESSORS  // code for each of them, chosen when this is loaded
#define PUBLIC __attribute__((target_clones(PROCESSORS)))
#else
#define PUBLIC
#endif
#define INLINE static inline __attribute__((always_inline))

enum { MARGIN = 16 };  // samples around each row of the workspace; two of them are used

struct factors {
  int16_t black, luma, red, green_u, green_v, blue;
};

// a b / 2^15, rounded: written so, one instruction of x86 and of ARM
INLINE int16_t product(int16_t a, int16_t b) { return (int16_t)((((a * b) >> 14) + 1) >> 1); }

INLINE uint8_t level(int16_t value) {
  value >>= 5;
  return (uint8_t)(value < 0 ? 0 : value > 255 ? 255 : value);
}

INLINE int within(int row, int rows) { return row < 0 ? 0 : row < rows ? row : rows - 1; }

INLINE int sample(const char *row, int x, int bits) {
  return bits == 8 ? ((const uint8_t *)row)[x] : ((const uint16_t *)row)[x];
}

// A row of chroma at the height of a row of the picture, around 0, of 10 bits.
INLINE void between(const char *plane, ptrdiff_t stride, int row, int rows, int columns, int bits,
                    int16_t *restrict half) {
  int near = row / 2, step = row & 1 ? 1 : -1;
  const char *a = plane + stride * near;
  const char *b = plane + stride * within(near + step, rows);
  const char *c = plane + stride * within(near - step, rows);
  const char *d = plane + stride * within(near + 2 * step, rows);
  for (int x = 0; x < columns; x++) {
    int16_t sum = (int16_t)(28 * sample(a, x, bits) + 8 * sample(b, x, bits) -
                            3 * sample(c, x, bits) - sample(d, x, bits) - (32 << (bits - 1)));
    half[x] = (int16_t)((sum + (1 << (bits - 6))) >> (bits - 5));
  }
  half[-2] = half[-1] = half[0];
  half[columns] = half[columns + 1] = half[columns - 1];
}

// The same at the columns of the picture, of 15 bits.
INLINE void widen(const int16_t *restrict half, int columns, int16_t *restrict whole) {
  for (int x = 0; x < columns; x++) {
    whole[2 * x] = (int16_t)(28 * half[x] + 8 * half[x - 1] - 3 * half[x + 1] - half[x - 2]);
    whole[2 * x + 1] = (int16_t)(28 * half[x] + 8 * half[x + 1] - 3 * half[x - 1] - half[x + 2]);
  }
}

INLINE void colours(const char *y, const int16_t *restrict u, const int16_t *restrict v, int width,
                    int bits, struct factors k, uint8_t *restrict red, uint8_t *restrict green,
                    uint8_t *restrict blue) {
  for (int x = 0; x < width; x++) {
    int16_t above = (int16_t)((sample(y, x, bits) - k.black) * (1 << (15 - bits)));
    int16_t light = (int16_t)(product(above, k.luma) + 16);
    red[x] = level((int16_t)(light + product(v[x], k.red)));
    green[x] = level((int16_t)(light - product(u[x], k.green_u) - product(v[x], k.green_v)));
    blue[x] = level((int16_t)(light + product(u[x], k.blue)));
  }
}

INLINE void interleave(const uint8_t *restrict a, const uint8_t *restrict b,
                       const uint8_t *restrict c, int width, uint8_t *restrict out) {
  for (int x = 0; x < width; x++) {
    out[3 * x] = a[x];
    out[3 * x + 1] = b[x];
    out[3 * x + 2] = c[x];
  }
}

INLINE void convert(const char *const planes[3], const ptrdiff_t strides[3], int width, int height,
                    int bits, const struct factors *k, int is_bgr, int16_t *work, uint8_t *out,
                    ptrdiff_t stride) {
  int columns = (width + 1) / 2, rows = (height + 1) / 2;
  int16_t *half = work + MARGIN, *u = half + columns + MARGIN, *v = u + 2 * columns;
  uint8_t *red = (uint8_t *)(v + 2 * columns), *green = red + width, *blue = green + width;
  for (int row = 0; row < height; row++) {
    between(planes[1], strides[1], row, rows, columns, bits, half);
    widen(half, columns, u);
    between(planes[2], strides[2], row, rows, columns, bits, half);
    widen(half, columns, v);
    colours(planes[0] + strides[0] * row, u, v, width, bits, *k, red, green, blue);
    interleave(is_bgr ? blue : red, green, is_bgr ? red : blue, width, out + stride * row);
  }
}

PUBLIC void mp4ds_rgb(const char *const planes[3], const ptrdiff_t strides[3], int width,
                      int height, int bits, const struct factors *k, int is_bgr, int16_t *work,
                      uint8_t *out, ptrdiff_t stride) {
  if (bits == 8)
    convert(planes, strides, width, height, 8, k, is_bgr, work, out, stride);
  else
    convert(planes, strides, width, height, 10, k, is_bgr, work, out, stride);
}
