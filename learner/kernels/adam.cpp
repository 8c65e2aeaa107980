// A step of Adam over all parameters at once. `learner.training.adam` defines the same in PyTorch;
// `learner.kernels.adam` calls this.

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "vectors.h"

namespace vmdnn {
namespace {

constexpr double kMeanDecay = 0.9;
constexpr double kSquareDecay = 0.999;
constexpr double kEpsilon = 1e-8;

template <typename Real>
double norm(const Real* values, std::int64_t count) {
  constexpr int kLanes = Simd<Real>::kLanes;
  Vector<Real> sums{};
  std::int64_t i = 0;
  for (; i + kLanes <= count; i += kLanes) {
    const Vector<Real> x = load(values + i);
    sums += x * x;
  }
  double total = 0;
  for (int lane = 0; lane < kLanes; ++lane) total += double(sums[lane]);
  for (; i < count; ++i) total += double(values[i]) * double(values[i]);
  return std::sqrt(total);
}

template <typename Real>
void step(std::int64_t count, Real* __restrict__ weights, Real* __restrict__ gradient,
          Real* __restrict__ means, Real* __restrict__ squares, std::int64_t number, double rate,
          double max_norm) {
  const Real factor = Real(std::min(1.0, max_norm / (norm(gradient, count) + 1e-6)));
  const Real mean_scale = Real(rate / (1 - std::pow(kMeanDecay, double(number))));
  const Real square_scale = Real(1 / (1 - std::pow(kSquareDecay, double(number))));
  for (std::int64_t i = 0; i < count; ++i) {
    const Real slope = factor * gradient[i];
    means[i] += Real(1 - kMeanDecay) * (slope - means[i]);
    squares[i] = Real(kSquareDecay) * squares[i] + Real(1 - kSquareDecay) * slope * slope;
    weights[i] -= mean_scale * means[i] / (std::sqrt(square_scale * squares[i]) + Real(kEpsilon));
    gradient[i] = 0;
  }
}

}  // namespace

extern "C" {

// Does a step of Adam. All arrays have `count` values. A gradient with a norm above `max_norm` is
// scaled down to it; the gradient is zero afterwards. `number` counts steps from 1 on.
void vmdnn_adam_float(std::int64_t count, float* weights, float* gradient, float* means,
                      float* squares, std::int64_t number, double rate, double max_norm) {
  step(count, weights, gradient, means, squares, number, rate, max_norm);
}

void vmdnn_adam_double(std::int64_t count, double* weights, double* gradient, double* means,
                       double* squares, std::int64_t number, double rate, double max_norm) {
  step(count, weights, gradient, means, squares, number, rate, max_norm);
}
}

}  // namespace vmdnn
