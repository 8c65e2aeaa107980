// Weighted sums of sequences: of the activity of V_S, and of the targets, which are then coded.
//
// `learner.training.interpolation` defines the same in PyTorch; `learner.kernels.mixing` calls
// this.

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "vectors.h"

namespace vmdnn {
namespace {

template <typename Real>
struct MixingProblem {
  std::int32_t mixtures;
  std::int32_t parts;  // sequences in each mixture
  std::int32_t steps;
  std::int32_t inputs;         // units of V_S
  std::int32_t values;         // of an action
  std::int32_t softmax_units;  // of each value
  const std::int64_t* members;  // (mixtures, parts) indices of sequences
  const Real* weights;          // (mixtures, parts)
  const Real* seen;             // (sequences, steps, inputs)
  const Real* targets;          // (sequences, steps, values)
  const Real* minima;           // (values)
  const Real* maxima;           // (values)
  const Real* references;       // (values, softmax_units)
  const Real* widths;           // (values)
  Real* mixed_seen;             // (mixtures, steps, inputs)
  Real* codes;                  // (mixtures, steps, values, softmax_units)
  Real* code_entropies;         // (mixtures, steps)
};

// to[i] = sum over parts of weights[part] from[part][i]
template <typename Real>
void mix(const Real* const* from, const Real* weights, int parts, std::ptrdiff_t count, Real* to) {
  constexpr int kLanes = Simd<Real>::kLanes;
  std::ptrdiff_t i = 0;
  for (; i + kLanes <= count; i += kLanes) {
    Vector<Real> sum = weights[0] * load(from[0] + i);
    for (int part = 1; part < parts; ++part) sum += weights[part] * load(from[part] + i);
    store(to + i, sum);
  }
  for (; i < count; ++i) {
    Real sum = 0;
    for (int part = 0; part < parts; ++part) sum += weights[part] * from[part][i];
    to[i] = sum;
  }
}

template <typename Real>
class Coding {
 public:
  explicit Coding(const MixingProblem<Real>& problem)
      : problem_(problem), excitations_(padded(problem.values * problem.softmax_units)) {}

  // Codes one action (values,); returns the sum of code * log(code).
  Real encode(const Real* action, Real* code) {
    constexpr int kLanes = Simd<Real>::kLanes;
    const int units = problem_.softmax_units;
    for (int value = 0; value < problem_.values; ++value) {
      const Real inside =
          std::clamp(action[value], problem_.minima[value], problem_.maxima[value]);
      for (int unit = 0; unit < units; ++unit) {
        const Real distance =
            (inside - problem_.references[value * units + unit]) / problem_.widths[value];
        excitations_[value * units + unit] = Real(-0.5) * distance * distance;
      }
    }
    Real entropy = 0;
    for (int value = 0; value < problem_.values; ++value) {
      const Real* logarithms = &excitations_[value * units];
      Real total = 0, mean = 0;
      for (int start = 0; start < units; start += kLanes) {
        const Vector<Real> powers = exp_of(load(logarithms + start));
        const int members = std::min(kLanes, units - start);
        for (int lane = 0; lane < members; ++lane) {
          code[lane + start] = powers[lane];
          total += powers[lane];
          mean += powers[lane] * logarithms[start + lane];
        }
      }
      for (int unit = 0; unit < units; ++unit) code[unit] /= total;
      entropy += mean / total - std::log(total);
      code += units;
    }
    return entropy;
  }

 private:
  // With room for a vector that is read from the last unit on.
  static std::size_t padded(int count) { return std::size_t(count) + Simd<Real>::kLanes; }

  const MixingProblem<Real>& problem_;
  std::vector<Real> excitations_;
};

template <typename Real>
void mix_all(const MixingProblem<Real>& problem) {
  const std::ptrdiff_t seen_size = std::ptrdiff_t(problem.steps) * problem.inputs;
  const std::ptrdiff_t target_size = std::ptrdiff_t(problem.steps) * problem.values;
  std::vector<const Real*> seen_parts(problem.parts), target_parts(problem.parts);
  std::vector<Real> targets(target_size);
  Coding<Real> coding(problem);
  for (int mixture = 0; mixture < problem.mixtures; ++mixture) {
    const std::int64_t* members = problem.members + std::ptrdiff_t(mixture) * problem.parts;
    const Real* weights = problem.weights + std::ptrdiff_t(mixture) * problem.parts;
    for (int part = 0; part < problem.parts; ++part) {
      seen_parts[part] = problem.seen + members[part] * seen_size;
      target_parts[part] = problem.targets + members[part] * target_size;
    }
    mix(seen_parts.data(), weights, problem.parts, seen_size,
        problem.mixed_seen + mixture * seen_size);
    mix(target_parts.data(), weights, problem.parts, target_size, targets.data());
    for (int step = 0; step < problem.steps; ++step) {
      const std::ptrdiff_t place = std::ptrdiff_t(mixture) * problem.steps + step;
      problem.code_entropies[place] =
          coding.encode(targets.data() + std::ptrdiff_t(step) * problem.values,
                        problem.codes + place * problem.values * problem.softmax_units);
    }
  }
}

}  // namespace
}  // namespace vmdnn

extern "C" {

void vmdnn_mix_float(const vmdnn::MixingProblem<float>* problem) { vmdnn::mix_all(*problem); }
void vmdnn_mix_double(const vmdnn::MixingProblem<double>* problem) { vmdnn::mix_all(*problem); }

}  // extern "C"
