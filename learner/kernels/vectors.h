// Vectors of the processor, and functions of them that a network needs.

#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace vmdnn {

constexpr double kGain = 1.7159;  // eq. (2)
constexpr double kSlope = 2.0 / 3.0;

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

#if defined(__AVX512F__) || defined(__aarch64__)
constexpr int kRegisters = 32;
#else
constexpr int kRegisters = 16;
#endif

template <typename Real>
struct Simd {
  static constexpr int kLanes = kVectorBytes / int(sizeof(Real));
  typedef Real Vector __attribute__((vector_size(kVectorBytes)));
};

template <typename Real>
using Vector = typename Simd<Real>::Vector;

template <typename Real>
inline Vector<Real> load(const Real* from) {
  Vector<Real> vector;
  std::memcpy(&vector, from, sizeof vector);
  return vector;
}

template <typename Real>
inline void store(Real* to, const Vector<Real>& vector) {
  std::memcpy(to, &vector, sizeof vector);
}

// Functions of vectors. The float versions are minimax fits with errors below 4e-7 relative.

template <typename Vec, typename... Real>
inline Vec polynomial(const Vec& x, double highest, Real... lower) {
  Vec result = Vec{} + decltype(x[0] + x[0])(highest);
  ((result = result * x + decltype(x[0] + x[0])(lower)), ...);
  return result;
}

template <typename Function>
inline Vector<double> each_lane(Vector<double> x, Function function) {
  for (int lane = 0; lane < Simd<double>::kLanes; ++lane) x[lane] = function(x[lane]);
  return x;
}

inline Vector<double> tanh_of(const Vector<double>& x) {
  return each_lane(x, [](double value) { return std::tanh(value); });
}

inline Vector<double> exp_of(const Vector<double>& x) {
  return each_lane(x, [](double value) { return std::exp(value); });
}

inline Vector<double> log_of(const Vector<double>& x) {
  return each_lane(x, [](double value) { return std::log(value); });
}

inline Vector<float> tanh_of(const Vector<float>& argument) {
  constexpr float kFlat = 9;  // from here on the nearest float is 1
  Vector<float> x = argument < kFlat ? argument : Vector<float>{} + kFlat;
  x = x > -kFlat ? x : Vector<float>{} - kFlat;
  const Vector<float> square = x * x;
  const Vector<float> above = polynomial(square, 1.335340532e-08, 2.060817859e-05, 3.495534134e-03,
                                         1.338098080e-01, 9.999999796e-01);
  const Vector<float> below = polynomial(square, 7.776043805e-07, 3.285545684e-04, 2.587677853e-02,
                                         4.671429646e-01, 1.0);
  return x * above / below;
}

typedef std::int32_t Integers __attribute__((vector_size(kVectorBytes)));

// For x <= 0.
inline Vector<float> exp_of(const Vector<float>& argument) {
  constexpr float kRound = 12582912;  // 1.5 * 2^23: adding it rounds to an integer
  const Vector<float> x = argument > -87.0f ? argument : Vector<float>{} - 87.0f;
  const Vector<float> rounded = x * 1.44269504f + kRound;
  const Vector<float> twos = rounded - kRound;
  const Vector<float> rest = (x - twos * 0.693359375f) + twos * 2.12194440e-4f;  // ln 2 in 2 parts
  const Vector<float> power =
      polynomial(rest, 1.383684192e-03, 8.374815782e-03, 4.166822564e-02, 1.666642017e-01,
                 4.999999208e-01, 1.000000036e+00, 1.000000001e+00);
  return Vector<float>(Integers(power) + (Integers(rounded) << 23));
}

// For normal x > 0.
inline Vector<float> log_of(const Vector<float>& x) {
  constexpr std::int32_t kRootHalf = 0x3f3504f3;  // bits of sqrt(1/2)
  const Integers twos = (Integers(x) - kRootHalf) >> 23;
  const Vector<float> part = Vector<float>(Integers(x) - (twos << 23)) - 1.0f;
  const Vector<float> quotient = polynomial(
      part, 8.722243253e-02, -1.436678817e-01, 1.495228303e-01, -1.656240195e-01, 1.995683282e-01,
      -2.500207365e-01, 3.333418564e-01, -4.999998797e-01, 9.999999742e-01);
  return part * quotient + __builtin_convertvector(twos, Vector<float>) * 0.693147181f;
}

template <typename Vec>
inline Vec larger(const Vec& a, const Vec& b) {
  return a > b ? a : b;
}

}  // namespace vmdnn
