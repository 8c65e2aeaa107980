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
  const Real* weights;          // (mixtures, parts) for V_S; parts of weight zero are not read
  const Real* target_weights;   // (mixtures, parts) the same for the targets
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

// The sequences of one mixture that count.
template <typename Real>
class Parts {
 public:
  explicit Parts(int most) : from_(most), weights_(most) {}

  // Takes those with a weight out of `all`, which holds `size` numbers for each sequence.
  void choose(const Real* all, std::ptrdiff_t size, const std::int64_t* members,
              const Real* weights) {
    count_ = 0;
    for (std::size_t part = 0; part < from_.size(); ++part) {
      if (weights[part] == 0) continue;
      from_[count_] = all + members[part] * size;
      weights_[count_++] = weights[part];
    }
  }

  // to[i] = sum over the parts of weight * from[i]
  void mix(std::ptrdiff_t size, Real* to) const {
    constexpr int kLanes = Simd<Real>::kLanes;
    std::ptrdiff_t i = 0;
    for (; i + kLanes <= size; i += kLanes) {
      Vector<Real> sum = {};
      for (int part = 0; part < count_; ++part) sum += weights_[part] * load(from_[part] + i);
      store(to + i, sum);
    }
    for (; i < size; ++i) {
      Real sum = 0;
      for (int part = 0; part < count_; ++part) sum += weights_[part] * from_[part][i];
      to[i] = sum;
    }
  }

 private:
  std::vector<const Real*> from_;
  std::vector<Real> weights_;
  int count_ = 0;
};

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
  std::vector<Real> targets(target_size);
  Parts<Real> parts(problem.parts);
  Coding<Real> coding(problem);
  for (int mixture = 0; mixture < problem.mixtures; ++mixture) {
    const std::ptrdiff_t first = std::ptrdiff_t(mixture) * problem.parts;
    const std::int64_t* members = problem.members + first;
    parts.choose(problem.seen, seen_size, members, problem.weights + first);
    parts.mix(seen_size, problem.mixed_seen + mixture * seen_size);
    parts.choose(problem.targets, target_size, members, problem.target_weights + first);
    parts.mix(target_size, targets.data());
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
