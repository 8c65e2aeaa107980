// One subnet of feature maps (V_F, V_S) over whole sequences, forward and backward.
//
// `learner.network.mstnn` defines the same in PyTorch; `learner.kernels.maps` calls this.
//
// A subnet's drive depends on the subnet below at the same step only, so frames of any steps and
// sequences can be convolved together: a vector holds one value of several frames, and a tile of
// neighbouring units of several maps is summed in registers. The leaky integration over the steps
// follows; there a vector holds neighbouring units. Each group of frames sums its own gradients,
// which are added in a fixed order, so that the results do not depend on the threads.

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "lanes.h"
#include "threads.h"

namespace vmdnn {
namespace {

constexpr int kMapsAtOnce = 3;   // maps of a tile
// Neighbouring units of a tile, or taps of a kernel: registers hold all sums of a tile, besides what
// they are summed from.
constexpr int kUnitsAtOnce = kRegisters == 32 ? 8 : 3;
constexpr int kRowsAtOnce = 6;   // rows whose activity stays in the cache for a kernel's gradient
constexpr int kSegment = 512;    // units that are integrated together

template <typename Real>
struct MapsProblem {
  std::int32_t sequences;  // B
  std::int32_t steps;      // T
  std::int32_t threads;
  std::int32_t maps_below, height_below, width_below;
  std::int32_t maps, kernel_height, kernel_width, stride;
  double leak;                // 1 / tau
  const Real* below;          // (B, T, maps below, height below, width below)
  const Real* kernel;         // (maps, maps below, kernel height, kernel width)
  const Real* bias;           // (maps,)
  Real* activity;             // (B, T, maps, height, width)
  const Real* by_activity;    // this and all below: for the backward pass only
  Real* by_drive;             // shaped as activity
  Real* by_kernel;
  Real* by_bias;
  Real* by_below;             // or null
};

// A convolution of x (channels, height, width) into (maps, rows, columns).
struct Shape {
  int channels, height, width;
  int maps, rows, columns;
  int kernel_height, kernel_width, stride;

  int taps() const { return channels * kernel_height * kernel_width; }
};

// Calls function(index, thread) for every index below count.
template <typename Function>
void share(int count, int threads, Function function) {
  std::atomic<int> next{0};
  run_in_threads(std::min(threads, count), [&](int thread) {
    for (int index = next++; index < count; index = next++) function(index, thread);
  });
}

// Divides `count` into tiles; calls function(size, begin) for each, with size an integral constant.
template <int kLargest, typename Function>
inline void tiles(int count, Function function, int begin = 0) {
  while (count - begin >= kLargest) {
    function(std::integral_constant<int, kLargest>(), begin);
    begin += kLargest;
  }
  if constexpr (kLargest > 1) {
    constexpr int kNext = kLargest > 4 ? kLargest - 2 : kLargest - 1;
    if (begin < count) tiles<kNext>(count, function, begin);
  }
}

// Packs weights element(map, channel, row, column) in the order in which `convolve` reads them.
template <typename Real, typename Element>
void pack(const Shape& shape, Real* packed, Element element) {
  tiles<kMapsAtOnce>(shape.maps, [&](auto maps, int map) {
    for (int c = 0; c < shape.channels; ++c) {
      for (int y = 0; y < shape.kernel_height; ++y) {
        for (int x = 0; x < shape.kernel_width; ++x) {
          for (int i = 0; i < maps; ++i) *packed++ = element(map + i, c, y, x);
        }
      }
    }
  });
}

// Adds the convolution for kUnits neighbouring units of kMaps maps to sums.
template <typename Real, int kMaps, int kUnits>
inline void convolve_tile(const Shape& shape, const Vector<Real>* x, const Real* weights,
                          Vector<Real> (&sums)[kMaps][kUnits]) {
  for (int c = 0; c < shape.channels; ++c) {
    for (int ky = 0; ky < shape.kernel_height; ++ky) {
      const Vector<Real>* line = x + (std::ptrdiff_t(c) * shape.height + ky) * shape.width;
      for (int kx = 0; kx < shape.kernel_width; ++kx, ++line, weights += kMaps) {
#pragma GCC unroll 8
        for (int j = 0; j < kUnits; ++j) {
          const Vector<Real> factor = line[j * shape.stride];
#pragma GCC unroll 4
          for (int i = 0; i < kMaps; ++i) sums[i][j] += weights[i] * factor;
        }
      }
    }
  }
}

// Convolves; sums start from begin(map), and put(map, row, column, vector) takes each result.
template <typename Real, typename Begin, typename Put>
void convolve(const Shape& shape, const Vector<Real>* x, const Real* packed, Begin begin, Put put) {
  tiles<kMapsAtOnce>(shape.maps, [&](auto maps, int map) {
    constexpr int kMaps = maps;
    const Real* weights = packed + std::ptrdiff_t(map) * shape.taps();
    for (int row = 0; row < shape.rows; ++row) {
      tiles<kUnitsAtOnce>(shape.columns, [&](auto units, int column) {
        constexpr int kUnits = units;
        Vector<Real> sums[kMaps][kUnits];
        for (int i = 0; i < kMaps; ++i) {
          for (int j = 0; j < kUnits; ++j) sums[i][j] = Vector<Real>{} + begin(map + i);
        }
        const std::ptrdiff_t corner = std::ptrdiff_t(row) * shape.width + column;
        convolve_tile<Real, kMaps, kUnits>(shape, x + shape.stride * corner, weights, sums);
        for (int i = 0; i < kMaps; ++i) {
          for (int j = 0; j < kUnits; ++j) put(map + i, row, column + j, sums[i][j]);
        }
      });
    }
  });
}

// Adds the gradient by the kernel (maps, channels, kernel height, kernel width) for the deltas
// (maps, rows, columns) to by_kernel.
template <typename Real>
void add_kernel_gradient(const Shape& shape, const Vector<Real>* x, const Vector<Real>* deltas,
                         Real* by_kernel) {
  constexpr int kLanes = Simd<Real>::kLanes;
  const std::ptrdiff_t area = std::ptrdiff_t(shape.rows) * shape.columns;
  for (int first = 0; first < shape.rows; first += kRowsAtOnce) {
    const int end = std::min(first + kRowsAtOnce, shape.rows);
    for (int line = 0; line < shape.channels * shape.kernel_height; ++line) {
      const int c = line / shape.kernel_height, ky = line % shape.kernel_height;
      const Vector<Real>* source = x + (std::ptrdiff_t(c) * shape.height + ky) * shape.width;
      tiles<kMapsAtOnce>(shape.maps, [&](auto maps, int map) {
        constexpr int kMaps = maps;
        tiles<kUnitsAtOnce>(shape.kernel_width, [&](auto taps, int kx) {
          constexpr int kTaps = taps;
          constexpr int kPadded = (kMaps * kTaps + kLanes - 1) / kLanes * kLanes;
          Vector<Real> sums[kPadded] = {};
          for (int row = first; row < end; ++row) {
            const Vector<Real>* factor =
                source + std::ptrdiff_t(row) * shape.stride * shape.width + kx;
            const Vector<Real>* delta =
                deltas + map * area + std::ptrdiff_t(row) * shape.columns;
            for (int column = 0; column < shape.columns;
                 ++column, ++delta, factor += shape.stride) {
              Vector<Real> of_map[kMaps];
              for (int i = 0; i < kMaps; ++i) of_map[i] = delta[i * area];
#pragma GCC unroll 8
              for (int j = 0; j < kTaps; ++j) {
                const Vector<Real> below = factor[j];
#pragma GCC unroll 4
                for (int i = 0; i < kMaps; ++i) sums[i * kTaps + j] += of_map[i] * below;
              }
            }
          }
          Real results[kPadded];
          for (int start = 0; start < kPadded; start += kLanes) {
            store(results + start, sums_of_lanes<Real>(sums + start));
          }
          const int lines = shape.channels * shape.kernel_height;
          for (int i = 0; i < kMaps; ++i) {
            Real* sum = by_kernel + (std::ptrdiff_t(map + i) * lines + line) * shape.kernel_width;
            for (int j = 0; j < kTaps; ++j) sum[kx + j] += results[i * kTaps + j];
          }
        });
      });
    }
  }
}

template <typename Real>
class MapsPass {
 public:
  MapsPass(const MapsProblem<Real>& problem, Arena& arena);
  void forward();
  void backward();

 private:
  using Vec = Vector<Real>;
  static constexpr int kLanes = Simd<Real>::kLanes;

  struct Scratch {
    Vec* below;   // of a frame
    Vec* drive;   // of a frame
    Vec* padded;  // drive with zeros around
  };

  // Units below whose row and column have the same remainders when divided by the stride get their
  // deltas by one convolution; each pair of remainders is a phase.
  struct Phase {
    Shape shape;
    int row, column;   // remainders
    int top, left;     // position in the padded deltas at which it begins
    Real* packed;
  };

  int frames() const { return problem_.sequences * problem_.steps; }
  int groups() const { return (frames() + kLanes - 1) / kLanes; }
  int units() const { return shape_.maps * shape_.rows * shape_.columns; }
  int units_below() const { return shape_.channels * shape_.height * shape_.width; }
  int kernel_size() const { return shape_.maps * shape_.taps(); }
  int segments() const { return (units() + kSegment - 1) / kSegment; }
  int padding(int kernel) const { return (kernel + shape_.stride - 1) / shape_.stride - 1; }
  int padded_height() const { return shape_.rows + 2 * padding(shape_.kernel_height) + 1; }
  int padded_width() const { return shape_.columns + 2 * padding(shape_.kernel_width) + 1; }

  void describe_phases();
  void take_memory(Arena& arena);
  void pack_weights();
  int members(int group) const { return std::min(kLanes, frames() - group * kLanes); }
  void gather_frames(const Real* arrays, int size, int group, const Real* beyond, Vec* to) const;
  void scatter_frames(const Vec* from, int size, int group, Real* arrays) const;
  void drive(int group, const Scratch& scratch) const;
  void leak(int index) const;
  void leak_backward(int index) const;
  void gradients(int group, const Scratch& scratch) const;
  void give_below(int group, const Scratch& scratch) const;
  void add_up() const;

  const MapsProblem<Real>& problem_;
  Shape shape_;
  std::vector<Phase> phases_;
  std::vector<Scratch> scratch_;
  Real* packed_ = nullptr;
  Real* zeros_ = nullptr;  // a frame of drive
  Real* sums_ = nullptr;   // (groups, kernel and bias)
};

template <typename Real>
MapsPass<Real>::MapsPass(const MapsProblem<Real>& problem, Arena& arena) : problem_(problem) {
  shape_ = {problem.maps_below,
            problem.height_below,
            problem.width_below,
            problem.maps,
            (problem.height_below - problem.kernel_height) / problem.stride + 1,
            (problem.width_below - problem.kernel_width) / problem.stride + 1,
            problem.kernel_height,
            problem.kernel_width,
            problem.stride};
  if (problem.by_below != nullptr) describe_phases();
  arena.allocate([&] { take_memory(arena); });
  pack_weights();
}

template <typename Real>
void MapsPass<Real>::describe_phases() {
  const int stride = shape_.stride;
  const auto part = [stride](int size, int remainder) {
    return (size - remainder + stride - 1) / stride;
  };
  for (int row = 0; row < std::min(stride, shape_.height); ++row) {
    for (int column = 0; column < std::min(stride, shape_.width); ++column) {
      Phase phase{};
      const int height = part(shape_.kernel_height, row), width = part(shape_.kernel_width, column);
      phase.shape = {shape_.maps,
                     padded_height(),
                     padded_width(),
                     shape_.channels,
                     part(shape_.height, row),
                     part(shape_.width, column),
                     std::max(height, 0),
                     std::max(width, 0),
                     1};
      phase.row = row;
      phase.column = column;
      phase.top = padding(shape_.kernel_height) - phase.shape.kernel_height + 1;
      phase.left = padding(shape_.kernel_width) - phase.shape.kernel_width + 1;
      phases_.push_back(phase);
    }
  }
}

template <typename Real>
void MapsPass<Real>::take_memory(Arena& arena) {
  packed_ = arena.take<Real>(kernel_size());
  zeros_ = arena.take<Real>(units());
  sums_ = arena.take<Real>(std::size_t(groups()) * (kernel_size() + shape_.maps));
  for (Phase& phase : phases_) {
    phase.packed = arena.take<Real>(std::size_t(phase.shape.maps) * phase.shape.taps());
  }
  scratch_.resize(problem_.threads);
  for (Scratch& scratch : scratch_) {
    scratch.below = arena.take<Vec>(units_below());
    scratch.drive = arena.take<Vec>(units());
    scratch.padded = arena.take<Vec>(std::size_t(shape_.maps) * padded_height() * padded_width());
  }
}

template <typename Real>
void MapsPass<Real>::pack_weights() {
  const auto weight = [this](int map, int c, int y, int x) {
    const std::ptrdiff_t row =
        (std::ptrdiff_t(map) * shape_.channels + c) * shape_.kernel_height + y;
    return problem_.kernel[row * shape_.kernel_width + x];
  };
  pack(shape_, packed_, weight);
  std::fill(zeros_, zeros_ + units(), Real(0));
  for (const Phase& phase : phases_) {
    pack(phase.shape, phase.packed, [&](int channel, int map, int y, int x) {
      const int ky = phase.row + shape_.stride * (phase.shape.kernel_height - 1 - y);
      const int kx = phase.column + shape_.stride * (phase.shape.kernel_width - 1 - x);
      return weight(map, channel, ky, kx);
    });
  }
}

template <typename Real>
void MapsPass<Real>::forward() {
  share(groups(), problem_.threads, [this](int group, int t) { drive(group, scratch_[t]); });
  share(problem_.sequences * segments(), problem_.threads, [this](int i, int) { leak(i); });
}

template <typename Real>
void MapsPass<Real>::backward() {
  share(problem_.sequences * segments(), problem_.threads,
        [this](int i, int) { leak_backward(i); });
  share(groups(), problem_.threads, [this](int group, int t) { gradients(group, scratch_[t]); });
  add_up();
}

// Frames of `size` values, one in each lane; unused lanes get `beyond`, or repeat the last frame.
template <typename Real>
void MapsPass<Real>::gather_frames(const Real* arrays, int size, int group, const Real* beyond,
                                   Vec* to) const {
  const Real* frames[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const bool exists = lane < members(group);
    const int frame = group * kLanes + (exists ? lane : 0);
    frames[lane] = exists || beyond == nullptr ? arrays + std::ptrdiff_t(frame) * size : beyond;
  }
  gather(frames, size, to);
}

template <typename Real>
void MapsPass<Real>::scatter_frames(const Vec* from, int size, int group, Real* arrays) const {
  Real* frames[kLanes] = {};
  for (int lane = 0; lane < members(group); ++lane) {
    frames[lane] = arrays + std::ptrdiff_t(group * kLanes + lane) * size;
  }
  scatter(from, size, frames, members(group));
}

// eq. (3) without the leak, of some frames; it is kept where the activity will be.
template <typename Real>
void MapsPass<Real>::drive(int group, const Scratch& scratch) const {
  gather_frames(problem_.below, units_below(), group, nullptr, scratch.below);
  convolve<Real>(
      shape_, scratch.below, packed_, [this](int map) { return problem_.bias[map]; },
      [&](int map, int row, int column, const Vec& sum) {
        scratch.drive[(std::ptrdiff_t(map) * shape_.rows + row) * shape_.columns + column] = sum;
      });
  scatter_frames(scratch.drive, units(), group, problem_.activity);
}

// Calls function(offset, count) for the whole vectors of a segment of a row of units, and the rest.
template <typename Real, typename Function>
inline void each_vector(int segment, int units, Function function) {
  constexpr int kLanes = Simd<Real>::kLanes;
  const int end = std::min((segment + 1) * kSegment, units);
  for (int i = segment * kSegment; i < end; i += kLanes) function(i, std::min(kLanes, end - i));
}

template <typename Real>
inline Vector<Real> load_some(const Real* from, int count) {
  if (count == Simd<Real>::kLanes) return load(from);
  Vector<Real> vector{};
  std::memcpy(&vector, from, count * sizeof(Real));
  return vector;
}

template <typename Real>
inline void store_some(Real* to, const Vector<Real>& vector, int count) {
  if (count == Simd<Real>::kLanes) return store(to, vector);
  std::memcpy(to, &vector, count * sizeof(Real));
}

// The leaky integration of eq. (3), and eq. (4), in place, for a segment of units of one sequence.
template <typename Real>
void MapsPass<Real>::leak(int index) const {
  const Real leak = Real(problem_.leak);
  Vec potentials[kSegment / kLanes] = {};
  Real* row = problem_.activity + std::ptrdiff_t(index / segments()) * problem_.steps * units();
  for (int t = 0; t < problem_.steps; ++t, row += units()) {
    Vec* potential = potentials;
    each_vector<Real>(index % segments(), units(), [&](int i, int count) {
      *potential += leak * (load_some(row + i, count) - *potential);
      store_some(row + i, Real(kGain) * tanh_of(Real(kSlope) * *potential++), count);
    });
  }
}

// The deltas of a segment of units of one sequence, from the last step to the first.
template <typename Real>
void MapsPass<Real>::leak_backward(int index) const {
  const Real leak = Real(problem_.leak);
  Vec deltas[kSegment / kLanes] = {};
  const std::ptrdiff_t first = std::ptrdiff_t(index / segments()) * problem_.steps * units();
  for (int t = problem_.steps - 1; t >= 0; --t) {
    const std::ptrdiff_t row = first + std::ptrdiff_t(t) * units();
    Vec* delta = deltas;
    each_vector<Real>(index % segments(), units(), [&](int i, int count) {
      const Vec y = load_some(problem_.activity + row + i, count);
      const Vec slope = Real(kSlope * kGain) - Real(kSlope / kGain) * y * y;
      *delta += load_some(problem_.by_activity + row + i, count) * slope - leak * *delta;
      store_some(problem_.by_drive + row + i, leak * *delta++, count);
    });
  }
}

template <typename Real>
void MapsPass<Real>::gradients(int group, const Scratch& scratch) const {
  gather_frames(problem_.by_drive, units(), group, zeros_, scratch.drive);
  gather_frames(problem_.below, units_below(), group, nullptr, scratch.below);
  Real* sums = sums_ + std::ptrdiff_t(group) * (kernel_size() + shape_.maps);
  std::fill(sums, sums + kernel_size() + shape_.maps, Real(0));
  add_kernel_gradient<Real>(shape_, scratch.below, scratch.drive, sums);
  const int area = shape_.rows * shape_.columns;
  for (int map = 0; map < shape_.maps; ++map) {
    Vec total{};
    for (int i = 0; i < area; ++i) total += scratch.drive[map * area + i];
    for (int lane = 0; lane < kLanes; ++lane) sums[kernel_size() + map] += total[lane];
  }
  if (problem_.by_below != nullptr) give_below(group, scratch);
}

template <typename Real>
void MapsPass<Real>::give_below(int group, const Scratch& scratch) const {
  const int height = padded_height(), width = padded_width();
  std::fill(scratch.padded, scratch.padded + std::ptrdiff_t(shape_.maps) * height * width, Vec{});
  const int top = padding(shape_.kernel_height), left = padding(shape_.kernel_width);
  for (int line = 0; line < shape_.maps * shape_.rows; ++line) {
    const int map = line / shape_.rows, row = line % shape_.rows;
    std::copy_n(scratch.drive + std::ptrdiff_t(line) * shape_.columns, shape_.columns,
                scratch.padded + (std::ptrdiff_t(map) * height + top + row) * width + left);
  }
  for (const Phase& phase : phases_) {
    convolve<Real>(
        phase.shape, scratch.padded + std::ptrdiff_t(phase.top) * width + phase.left,
        phase.packed, [](int) { return Real(0); },
        [&](int channel, int row, int column, const Vec& sum) {
          const int y = shape_.stride * row + phase.row;
          const int x = shape_.stride * column + phase.column;
          scratch.below[(std::ptrdiff_t(channel) * shape_.height + y) * shape_.width + x] = sum;
        });
  }
  scatter_frames(scratch.below, units_below(), group, problem_.by_below);
}

template <typename Real>
void MapsPass<Real>::add_up() const {
  std::fill(problem_.by_kernel, problem_.by_kernel + kernel_size(), Real(0));
  std::fill(problem_.by_bias, problem_.by_bias + shape_.maps, Real(0));
  const Real* sums = sums_;
  for (int group = 0; group < groups(); ++group) {
    for (int i = 0; i < kernel_size(); ++i) problem_.by_kernel[i] += *sums++;
    for (int i = 0; i < shape_.maps; ++i) problem_.by_bias[i] += *sums++;
  }
}

template <typename Real>
int compute(const MapsProblem<Real>* problem) {
  static thread_local Arena arena;
  try {
    MapsPass<Real> pass(*problem, arena);
    problem->by_activity == nullptr ? pass.forward() : pass.backward();
  } catch (const std::bad_alloc&) {
    return 1;
  }
  return 0;
}

}  // namespace

extern "C" {

int vmdnn_maps_float(const MapsProblem<float>* problem) { return compute(problem); }

int vmdnn_maps_double(const MapsProblem<double>* problem) { return compute(problem); }
}

}  // namespace vmdnn
