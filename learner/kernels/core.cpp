// The recurrent core PFC > M_S > M_F > M_O, forward and backward through whole sequences.
//
// One call computes, from the activity of V_S and the teacher's outputs, the Kullback-Leibler
// divergence of eq. (5) and its gradients: those of the paper's eq. (6), plus the paths within a
// step. `learner.training.divergence` defines the same in PyTorch; `learner.kernels.core` calls
// this.
//
// Why it is fast:
// - Sequences are grouped, with one sequence in each vector lane. An array of vectors holds one
//   value of each sequence of a group. Products of weights and states then need no sums across
//   lanes, and only the connections that exist are computed.
// - Every product sums a tile of results in registers.
// - Only the two scans depend on the order of the steps. All other work is divided into chunks of
//   steps, which the threads share. Intermediate results of a chunk stay in the cache.
// - Each chunk writes its own sums, which are added in a fixed order at the end. So the results do
//   not depend on the threads.
//
// With h = tanh(v), v = slope u and y = gain h, a step needs no factors: the packed weights, and at
// the end the gradients, are multiplied by gain, slope and 1 / tau.

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <mutex>
#include <new>
#include <numeric>
#include <thread>  // std::this_thread::yield
#include <vector>

#include "lanes.h"
#include "threads.h"

namespace vmdnn {
namespace {

constexpr int kTile = 10;   // results of a product in registers; units are padded to its multiples
constexpr int kChunk = 32;  // steps of a chunk
constexpr bool kManyRegisters = kRegisters == 32;
constexpr int kSide = 5;    // rows of a tile of a weight gradient
constexpr int kAcross = kManyRegisters ? 5 : 2;  // columns of such a tile
constexpr int kWide = kManyRegisters ? 3 : 2;    // vectors in a tile of the input weights' gradient
static_assert(kTile % kSide == 0 && kTile % kAcross == 0, "sizes are multiples of kTile");

// ---------------------------------------------------------------------------------------------
// Products

// sums[i] += sum over k of weights[k][i] x[k], for one tile of packed weights.
template <typename Real>
inline void add_product(const Real* weights, int columns, const Vector<Real>* x,
                        Vector<Real>* sums) {
  for (int k = 0; k < columns; ++k, weights += kTile) {
    const Vector<Real> factor = x[k];
#pragma GCC unroll 10
    for (int i = 0; i < kTile; ++i) sums[i] += weights[i] * factor;
  }
}

// sums[i][j] (+)= sum over steps and lanes of left[step][i] right[step][j].
// Adds to `sums` (rows x columns), whose sizes are multiples of kTile.
template <typename Real>
void add_outer_products(const Vector<Real>* left, int left_pitch, int rows,
                        const Vector<Real>* right, int right_pitch, int columns, int steps,
                        Real* sums) {
  constexpr int kLanes = Simd<Real>::kLanes;
  constexpr int kPadded = (kSide * kAcross + kLanes - 1) / kLanes * kLanes;
  for (int row = 0; row < rows; row += kSide) {
    for (int column = 0; column < columns; column += kAcross) {
      Vector<Real> tile[kPadded] = {};
      const Vector<Real>* a = left + row;
      const Vector<Real>* b = right + column;
      for (int step = 0; step < steps; ++step, a += left_pitch, b += right_pitch) {
        Vector<Real> factor[kAcross];
        for (int j = 0; j < kAcross; ++j) factor[j] = b[j];
#pragma GCC unroll 5
        for (int i = 0; i < kSide; ++i) {
          const Vector<Real> row_factor = a[i];
#pragma GCC unroll 5
          for (int j = 0; j < kAcross; ++j) tile[i * kAcross + j] += row_factor * factor[j];
        }
      }
      Real results[kPadded];
      for (int start = 0; start < kPadded; start += kLanes) {
        store(results + start, sums_of_lanes<Real>(tile + start));
      }
      for (int i = 0; i < kSide; ++i) {
        Real* sum = sums + std::ptrdiff_t(row + i) * columns + column;
        for (int j = 0; j < kAcross; ++j) sum[j] += results[i * kAcross + j];
      }
    }
  }
}

// sums[i] += sum over steps and lanes of vectors[step][i].
template <typename Real>
void add_totals(const Vector<Real>* vectors, int pitch, int rows, int steps, Real* sums) {
  for (int row = 0; row < rows; ++row) {
    Vector<Real> total{};
    for (int step = 0; step < steps; ++step) total += vectors[std::ptrdiff_t(step) * pitch + row];
    for (int lane = 0; lane < Simd<Real>::kLanes; ++lane) sums[row] += total[lane];
  }
}

// sums[i][f] += sum over steps of left[step][i] right[step][f], for kSide values of i and kVectors
// vectors of neighbouring f.
template <typename Real, int kVectors>
inline void add_rank_products(const Real* left, int left_pitch, const Real* right, int pitch,
                              int steps, Real* sums) {
  constexpr int kLanes = Simd<Real>::kLanes;
  Vector<Real> tile[kSide][kVectors];
#pragma GCC unroll 5
  for (int i = 0; i < kSide; ++i) {
#pragma GCC unroll 4
    for (int v = 0; v < kVectors; ++v) {
      tile[i][v] = load(sums + std::ptrdiff_t(i) * pitch + v * kLanes);
    }
  }
  for (int step = 0; step < steps; ++step, left += left_pitch, right += pitch) {
    Vector<Real> factor[kVectors];
#pragma GCC unroll 4
    for (int v = 0; v < kVectors; ++v) factor[v] = load(right + v * kLanes);
#pragma GCC unroll 5
    for (int i = 0; i < kSide; ++i) {
#pragma GCC unroll 4
      for (int v = 0; v < kVectors; ++v) tile[i][v] += left[i] * factor[v];
    }
  }
#pragma GCC unroll 5
  for (int i = 0; i < kSide; ++i) {
#pragma GCC unroll 4
    for (int v = 0; v < kVectors; ++v) {
      store(sums + std::ptrdiff_t(i) * pitch + v * kLanes, tile[i][v]);
    }
  }
}

// ---------------------------------------------------------------------------------------------
// The problem

template <typename Real>
struct CoreProblem {
  std::int32_t levels;         // PFC, M_S, M_F
  std::int32_t inputs;         // units of V_S
  std::int32_t values;         // of an action
  std::int32_t softmax_units;  // of each value
  std::int32_t literal;        // whether every connection takes one step, as eq. (1) is printed
  std::int32_t sequences;      // B
  std::int32_t steps;          // T
  std::int32_t threads;
  const std::int32_t* units;     // (levels,)
  const double* leaks;           // (levels,) 1 / tau
  const std::int64_t* chosen;    // (B,) which of the S sequences
  const Real* seen;              // (S, T, inputs)
  const Real* codes;           // (S, T, values * softmax units), the teacher's outputs
  const Real* code_entropies;  // (S, T) sum of codes * log(codes)
  const Real* mask;            // (S, T) one where a sequence has a step
  const Real* initial;           // (B, all units) potentials before the first step; null: zero
  const Real* shift;           // (B, inputs) added to `seen` at every step, or null
  // Of each level input, recurrent, feedback (but the last level) and bias; of the outputs input
  // and bias.
  const Real* const* parameters;
  double* divergence;
  Real* const* by_parameters;  // gradients are added to these; null: compute no gradients
  Real* by_drive;              // (B, T, units of the PFC) by the input from V_S, or null
  Real* by_initial;            // (B, all units), or null
  Real* by_shift;              // (B, units of the PFC) by the input from the shift, or null
};

struct Level {
  int units;
  int padded;   // to a multiple of kTile
  int start;    // of its padded units among those of all levels
  int first;    // of its units among those of all levels
  double keep;  // 1 - 1 / tau
  double scale;  // slope / tau
};

inline int padded_to_tiles(int units) { return (units + kTile - 1) / kTile * kTile; }

// Packs scale times a (rows x columns) matrix with these pitches into tiles of kTile rows: tile by
// tile, column by column, padded with zeros to whole tiles and `padded` columns.
template <typename Real>
void pack(Real* packed, const Real* matrix, int row_pitch, int column_pitch, int rows, int columns,
          int padded, Real scale) {
  for (int tile = 0; tile < rows; tile += kTile) {
    for (int column = 0; column < padded; ++column) {
      for (int row = tile; row < tile + kTile; ++row) {
        const bool exists = row < rows && column < columns;
        *packed++ = exists ? scale * matrix[std::ptrdiff_t(row) * row_pitch +
                                            std::ptrdiff_t(column) * column_pitch]
                           : Real(0);
      }
    }
  }
}

// to += scale times a (rows x columns) matrix with this pitch; `to` has no padding.
template <typename Real>
void add_scaled(const Real* matrix, int pitch, int rows, int columns, Real scale, Real* to) {
  for (int row = 0; row < rows; ++row, matrix += pitch, to += columns) {
    for (int column = 0; column < columns; ++column) to[column] += scale * matrix[column];
  }
}

// Weights from one level to another, or from M_F to M_O.
template <typename Real>
struct Connection {
  int to;
  int from;
  bool delayed;         // whether it takes one step
  int parameter;        // index of its (to.units, from.units) weights among the parameters
  std::ptrdiff_t sums;  // index of its gradient, with padded sizes, in the sums of a group
  Real scale;           // factor of the packed weights
  Real* forward;        // packed, rows `to`
  Real* backward;       // packed, rows `from`
};

enum Stage { kProject, kForward, kOutputs, kBackward, kInputs, kDone };

template <typename Real>
class Pass {
 public:
  Pass(const CoreProblem<Real>& problem, Arena& arena);
  void run();

 private:
  using Vec = Vector<Real>;
  static constexpr int kLanes = Simd<Real>::kLanes;

  // kLanes sequences and their arrays. Row t + 1 of hidden and deltas is step t, row 0 the state
  // before the first step.
  struct Group {
    int members;               // number of sequences; unused lanes repeat the last one
    int steps;                 // of the longest sequence
    int member[kLanes];        // index in the minibatch
    std::int64_t row[kLanes];  // index of the first step among the S * T steps
    Vec* hidden;              // (steps + 1, width)
    Vec* deltas;              // (steps + 2, width) gradient by v; at first by h of M_F
    Real* sums;               // gradients that the backward scan sums
    Real* output_sums;        // (chunks, ...)
    Real* input_sums;         // (chunks, ...)
    double* divergences;      // (chunks,)
    Stage stage;
    int next;        // first chunk of this stage that no thread has taken
    int unfinished;  // chunks of this stage that are not finished
  };

  struct Scratch {
    Vec* inputs;      // (inputs,)
    Vec* potentials;  // (width,) or (outputs,)
    Vec* targets;     // (outputs,)
    Vec* deltas;      // (kChunk, outputs)
    Real* rows;       // (lanes, kChunk, units of the PFC)
  };

  struct Task {
    Group* group;
    Stage stage;
    int chunk;
  };

  bool wants_gradients() const { return problem_.by_parameters != nullptr; }
  int chunks(const Group& group) const { return (group.steps + kChunk - 1) / kChunk; }
  int chunks(const Group& group, Stage stage) const {
    return stage == kForward || stage == kBackward ? 1 : chunks(group);
  }
  std::ptrdiff_t output_sums() const {
    return std::ptrdiff_t(outputs_) * (levels_.back().padded + 1);
  }
  std::ptrdiff_t input_sums() const {
    return std::ptrdiff_t(levels_[0].padded) * problem_.inputs;
  }

  void describe();
  void connect(int to, int from, bool delayed, int parameter);
  void form_groups();
  void take_memory(Arena& arena);
  void pack_weights();
  void pack_connection(Connection<Real>& connection, int to, int to_padded, const Level& from);
  static int urgency(const Group& group) {
    return group.stage == kForward || group.stage == kBackward ? kDone : -group.stage;
  }
  void work(const Scratch& scratch);
  bool claim(Task& task);
  void finish(const Task& task);
  void project(const Group& group, int chunk, const Scratch& scratch) const;
  void project_shift(const Group& group, const Scratch& scratch, Vec* drive) const;
  void scan_forward(Group& group, const Scratch& scratch) const;
  void start_rows(Group& group, Vec* potentials) const;
  void outputs(const Group& group, int chunk, const Scratch& scratch) const;
  Vec softmax(const Vec* potentials, const Vec* targets, Vec* deltas, const Vec& weight) const;
  void scan_backward(Group& group) const;
  void step_backward(Group& group, int row) const;
  void sum_gradients(const Group& group, int first, int end) const;
  void give_initial(const Group& group) const;
  void give_drive(const Group& group) const;
  void give_shift(const Group& group) const;
  Vec total_delta(const Group& group, int unit) const;
  void inputs(const Group& group, int chunk, const Scratch& scratch) const;
  void add_shift_gradients(const Group& group, const Scratch& scratch, Real* sums) const;
  void add_input_gradients(const Real* deltas, const Real* seen, int steps, const Real* soon,
                           Real* sums) const;
  void add_up() const;

  const CoreProblem<Real>& problem_;
  const int lag_;      // steps that the connection from V_S takes
  const int outputs_;  // units of M_O, padded
  int width_ = 0;      // units of all levels, padded
  int units_ = 0;      // units of all levels
  std::vector<Level> levels_;
  std::vector<int> biases_;                    // indices of the levels' biases in the parameters
  std::vector<Connection<Real>> connections_;  // between levels
  Connection<Real> to_outputs_{};
  int output_bias_ = 0;            // index in the parameters
  std::ptrdiff_t group_sums_ = 0;  // size of a group's sums: connections, then biases of the levels
  double weight_ = 0;              // weight of one value of one step in the mean
  std::vector<Group> groups_;
  std::vector<Scratch> scratch_;
  Real* packed_bias_ = nullptr;         // (width,)
  Real* packed_output_bias_ = nullptr;  // (outputs,)
  Real* packed_inputs_ = nullptr;
  std::mutex mutex_;
};

// --- description of the problem ---

template <typename Real>
Pass<Real>::Pass(const CoreProblem<Real>& problem, Arena& arena)
    : problem_(problem),
      lag_(problem.literal ? 1 : 0),
      outputs_(padded_to_tiles(problem.values * problem.softmax_units)) {
  describe();
  form_groups();
  arena.allocate([&] { take_memory(arena); });
  pack_weights();
}

template <typename Real>
void Pass<Real>::describe() {
  const int last = problem_.levels - 1;
  for (int l = 0; l <= last; ++l) {
    const double leak = problem_.leaks[l];
    const int units = problem_.units[l];
    levels_.push_back({units, padded_to_tiles(units), width_, units_, 1 - leak, kSlope * leak});
    width_ += levels_.back().padded;
    units_ += units;
  }
  int next = 1;  // of the parameters; the first are the weights from V_S
  for (int l = 0; l <= last; ++l) {
    if (l > 0) connect(l, l - 1, problem_.literal != 0, next++);
    connect(l, l, true, next++);
    if (l < last) connect(l, l + 1, true, next++);
    biases_.push_back(next++);
  }
  to_outputs_.parameter = next++;
  to_outputs_.scale = Real(kGain);
  output_bias_ = next;
  group_sums_ += width_;
}

template <typename Real>
void Pass<Real>::connect(int to, int from, bool delayed, int parameter) {
  Connection<Real> connection{};
  connection.to = to;
  connection.from = from;
  connection.delayed = delayed;
  connection.parameter = parameter;
  connection.scale = Real(kGain * levels_[to].scale);
  connection.sums = group_sums_;
  connections_.push_back(connection);
  group_sums_ += std::ptrdiff_t(levels_[to].padded) * levels_[from].padded;
}

// Groups sequences of similar length, the longest first.
template <typename Real>
void Pass<Real>::form_groups() {
  const int count = problem_.sequences;
  std::vector<int> lengths(count);
  double weight = 0;
  for (int b = 0; b < count; ++b) {
    const Real* mask = problem_.mask + problem_.chosen[b] * problem_.steps;
    for (int t = 0; t < problem_.steps; ++t) {
      weight += mask[t];
      if (mask[t] != 0) lengths[b] = t + 1;
    }
  }
  weight_ = 1 / (weight * problem_.values);
  std::vector<int> order(count);
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](int a, int b) { return lengths[a] > lengths[b]; });
  for (int begin = 0; begin < count; begin += kLanes) {
    Group group{};
    group.members = std::min(kLanes, count - begin);
    group.steps = std::max(1, lengths[order[begin]]);
    for (int lane = 0; lane < kLanes; ++lane) {
      group.member[lane] = order[begin + std::min(lane, group.members - 1)];
      group.row[lane] = problem_.chosen[group.member[lane]] * problem_.steps;
    }
    group.unfinished = chunks(group, kProject);
    groups_.push_back(group);
  }
}

template <typename Real>
void Pass<Real>::take_memory(Arena& arena) {
  const Level& first = levels_.front();
  const Level& last = levels_.back();
  for (Connection<Real>& connection : connections_) {
    const std::size_t size =
        std::size_t(levels_[connection.to].padded) * levels_[connection.from].padded;
    connection.forward = arena.take<Real>(size);
    connection.backward = arena.take<Real>(size);
  }
  to_outputs_.forward = arena.take<Real>(std::size_t(outputs_) * last.padded);
  to_outputs_.backward = arena.take<Real>(std::size_t(outputs_) * last.padded);
  packed_bias_ = arena.take<Real>(width_);
  packed_output_bias_ = arena.take<Real>(outputs_);
  packed_inputs_ = arena.take<Real>(std::size_t(first.padded) * problem_.inputs);
  for (Group& group : groups_) {
    group.hidden = arena.take<Vec>(std::size_t(group.steps + 1) * width_);
    group.divergences = arena.take<double>(chunks(group));
    if (!wants_gradients()) continue;
    group.deltas = arena.take<Vec>(std::size_t(group.steps + 2) * width_);
    group.sums = arena.take<Real>(group_sums_);
    group.output_sums = arena.take<Real>(chunks(group) * output_sums());
    group.input_sums = arena.take<Real>(chunks(group) * input_sums());
  }
  scratch_.resize(problem_.threads);
  for (Scratch& scratch : scratch_) {
    scratch.inputs = arena.take<Vec>(problem_.inputs);
    scratch.potentials = arena.take<Vec>(std::max(width_, outputs_));
    scratch.targets = arena.take<Vec>(outputs_);
    scratch.deltas = arena.take<Vec>(std::size_t(kChunk) * outputs_);
    scratch.rows = arena.take<Real>(std::size_t(kLanes) * kChunk * first.padded);
  }
}

template <typename Real>
void Pass<Real>::pack_weights() {
  for (Connection<Real>& connection : connections_) {
    pack_connection(connection, levels_[connection.to].units, levels_[connection.to].padded,
                    levels_[connection.from]);
  }
  const int outputs = problem_.values * problem_.softmax_units;
  pack_connection(to_outputs_, outputs, outputs_, levels_.back());
  for (std::size_t l = 0; l < levels_.size(); ++l) {
    const Real* bias = problem_.parameters[biases_[l]];
    for (int i = 0; i < levels_[l].padded; ++i) {
      packed_bias_[levels_[l].start + i] =
          i < levels_[l].units ? Real(levels_[l].scale) * bias[i] : Real(0);
    }
  }
  const Real* bias = problem_.parameters[output_bias_];
  for (int i = 0; i < outputs_; ++i) {
    packed_output_bias_[i] = i < outputs ? bias[i] : Real(0);
  }
  const Level& first = levels_.front();
  pack(packed_inputs_, problem_.parameters[0], problem_.inputs, 1, first.units, problem_.inputs,
       problem_.inputs, Real(first.scale));
}

template <typename Real>
void Pass<Real>::pack_connection(Connection<Real>& connection, int to, int to_padded,
                                 const Level& from) {
  const Real* weights = problem_.parameters[connection.parameter];
  pack(connection.forward, weights, from.units, 1, to, from.units, from.padded, connection.scale);
  pack(connection.backward, weights, 1, from.units, from.units, to, to_padded, connection.scale);
}

// --- distribution over threads ---

template <typename Real>
void Pass<Real>::run() {
  run_in_threads(problem_.threads, [this](int thread) { work(scratch_[thread]); });
  add_up();
}

template <typename Real>
void Pass<Real>::work(const Scratch& scratch) {
  Task task;
  while (claim(task)) {
    switch (task.stage) {
      case kProject: project(*task.group, task.chunk, scratch); break;
      case kForward: scan_forward(*task.group, scratch); break;
      case kOutputs: outputs(*task.group, task.chunk, scratch); break;
      case kBackward: scan_backward(*task.group); break;
      case kInputs: inputs(*task.group, task.chunk, scratch); break;
      case kDone: break;
    }
    finish(task);
  }
}

// Takes the next piece of work; returns false when all work is done. Only one thread at a time can
// scan a group. So scans come first, which keeps the groups at about the same stage; otherwise the
// other threads would wait for the last group. Few groups are begun, so that they fit in the cache.
template <typename Real>
bool Pass<Real>::claim(Task& task) {
  const int most_begun = problem_.threads == 1 ? 1 : problem_.threads + 1;
  for (bool done = false; !done; std::this_thread::yield()) {
    const std::lock_guard<std::mutex> lock(mutex_);
    int begun = 0;
    Group* best = nullptr;
    for (Group& group : groups_) {
      if (group.stage == kDone) continue;
      if (++begun > most_begun) break;
      const bool ready = group.next < chunks(group, group.stage);
      if (ready && (best == nullptr || urgency(group) > urgency(*best))) best = &group;
    }
    if (best != nullptr) {
      task = {best, best->stage, best->next++};
      return true;
    }
    done = begun == 0;
  }
  return false;
}

template <typename Real>
void Pass<Real>::finish(const Task& task) {
  const std::lock_guard<std::mutex> lock(mutex_);
  Group& group = *task.group;
  if (--group.unfinished > 0) return;
  group.stage = group.stage == kOutputs && !wants_gradients() ? kDone : Stage(group.stage + 1);
  group.next = 0;
  group.unfinished = chunks(group, group.stage);
}

// --- forward ---

// Writes the input of the PFC from V_S, with its biases, into the rows of `hidden`.
template <typename Real>
void Pass<Real>::project(const Group& group, int chunk, const Scratch& scratch) const {
  const Level& pfc = levels_.front();
  const int end = std::min((chunk + 1) * kChunk, group.steps);
  Vec* shift = scratch.potentials;
  project_shift(group, scratch, shift);
  for (int t = chunk * kChunk; t < end; ++t) {
    Vec* drive = group.hidden + std::ptrdiff_t(t + 1) * width_;
    const bool sees = t >= lag_;
    if (sees) {
      const Real* arrays[kLanes];
      for (int lane = 0; lane < kLanes; ++lane) {
        arrays[lane] = problem_.seen + (group.row[lane] + t - lag_) * problem_.inputs;
      }
      gather(arrays, problem_.inputs, scratch.inputs);
    }
    for (int tile = 0; tile < pfc.padded; tile += kTile) {
      Vec sums[kTile];
      for (int i = 0; i < kTile; ++i) sums[i] = Vec{} + packed_bias_[tile + i];
      if (sees) {
        for (int i = 0; i < kTile; ++i) sums[i] += shift[tile + i];
        add_product<Real>(packed_inputs_ + std::ptrdiff_t(tile) * problem_.inputs, problem_.inputs,
                          scratch.inputs, sums);
      }
      for (int i = 0; i < kTile; ++i) drive[tile + i] = sums[i];
    }
  }
}

// The input of the PFC from the shift of V_S, the same at every step.
template <typename Real>
void Pass<Real>::project_shift(const Group& group, const Scratch& scratch, Vec* drive) const {
  const Level& pfc = levels_.front();
  if (problem_.shift == nullptr) {
    std::fill(drive, drive + pfc.padded, Vec{});
    return;
  }
  const Real* arrays[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    arrays[lane] = problem_.shift + std::ptrdiff_t(group.member[lane]) * problem_.inputs;
  }
  gather(arrays, problem_.inputs, scratch.inputs);
  for (int tile = 0; tile < pfc.padded; tile += kTile) {
    Vec sums[kTile] = {};
    add_product<Real>(packed_inputs_ + std::ptrdiff_t(tile) * problem_.inputs, problem_.inputs,
                      scratch.inputs, sums);
    for (int i = 0; i < kTile; ++i) drive[tile + i] = sums[i];
  }
}

template <typename Real>
void Pass<Real>::scan_forward(Group& group, const Scratch& scratch) const {
  Vec* potentials = scratch.potentials;
  start_rows(group, potentials);
  for (int row = 1; row <= group.steps; ++row) {
    Vec* now = group.hidden + std::ptrdiff_t(row) * width_;
    const Vec* before = now - width_;
    for (int l = 0; l < int(levels_.size()); ++l) {
      const Level& level = levels_[l];
      for (int tile = 0; tile < level.padded; tile += kTile) {
        const int first = level.start + tile;
        Vec sums[kTile];
#pragma GCC unroll 10
        for (int i = 0; i < kTile; ++i) {
          const Vec drive = l == 0 ? now[first + i] : Vec{} + packed_bias_[first + i];
          sums[i] = Real(level.keep) * potentials[first + i] + drive;
        }
        for (const Connection<Real>& connection : connections_) {
          if (connection.to != l) continue;
          const Level& from = levels_[connection.from];
          add_product<Real>(connection.forward + std::ptrdiff_t(tile) * from.padded, from.padded,
                            (connection.delayed ? before : now) + from.start, sums);
        }
#pragma GCC unroll 10
        for (int i = 0; i < kTile; ++i) {
          potentials[first + i] = sums[i];
          now[first + i] = tanh_of(sums[i]);
        }
      }
    }
  }
}

// Sets the state before the first step, and the rows of `deltas` that nothing else writes.
template <typename Real>
void Pass<Real>::start_rows(Group& group, Vec* potentials) const {
  for (int i = 0; i < width_; ++i) potentials[i] = Vec{};
  if (problem_.initial != nullptr) {
    for (const Level& level : levels_) {
      for (int lane = 0; lane < kLanes; ++lane) {
        const Real* initial =
            problem_.initial + std::ptrdiff_t(group.member[lane]) * units_ + level.first;
        for (int i = 0; i < level.units; ++i) {
          potentials[level.start + i][lane] = Real(kSlope) * initial[i];
        }
      }
    }
  }
  for (int i = 0; i < width_; ++i) group.hidden[i] = tanh_of(potentials[i]);
  if (!wants_gradients()) return;
  Vec* unseen = group.deltas + (lag_ == 0 ? 0 : std::ptrdiff_t(group.steps) * width_);
  std::fill(unseen, unseen + width_, Vec{});  // no output depends on this row
  Vec* after = group.deltas + std::ptrdiff_t(group.steps + 1) * width_;
  std::fill(after, after + width_, Vec{});
}

// Softmax, divergence, and for eq. (6) the deltas of M_O and their contribution to those of M_F.
template <typename Real>
void Pass<Real>::outputs(const Group& group, int chunk, const Scratch& scratch) const {
  const Level& fast = levels_.back();
  const int begin = chunk * kChunk;
  const int end = std::min(begin + kChunk, group.steps);
  const int outputs = problem_.values * problem_.softmax_units;
  double divergence = 0;
  for (int t = begin; t < end; ++t) {
    const std::ptrdiff_t row = std::ptrdiff_t(t + 1 - lag_) * width_ + fast.start;
    Vec* potentials = scratch.potentials;
    for (int tile = 0; tile < outputs_; tile += kTile) {
      Vec sums[kTile];
#pragma GCC unroll 10
      for (int i = 0; i < kTile; ++i) sums[i] = Vec{} + packed_output_bias_[tile + i];
      add_product<Real>(to_outputs_.forward + std::ptrdiff_t(tile) * fast.padded, fast.padded,
                        group.hidden + row, sums);
#pragma GCC unroll 10
      for (int i = 0; i < kTile; ++i) potentials[tile + i] = sums[i];
    }
    const Real* arrays[kLanes];
    Vec mask{};
    double entropies = 0;
    for (int lane = 0; lane < kLanes; ++lane) {
      const std::int64_t at = group.row[lane] + t;
      arrays[lane] = problem_.codes + at * outputs;
      if (lane < group.members) {
        mask[lane] = problem_.mask[at];
        entropies += double(problem_.mask[at]) * double(problem_.code_entropies[at]);
      }
    }
    gather(arrays, outputs, scratch.targets);
    Vec* deltas = scratch.deltas + std::ptrdiff_t(t - begin) * outputs_;
    const Vec cross = mask * softmax(potentials, scratch.targets, deltas, mask * Real(weight_));
    divergence += entropies;
    for (int lane = 0; lane < kLanes; ++lane) divergence += double(cross[lane]);
    if (!wants_gradients()) continue;
    for (int i = outputs; i < outputs_; ++i) deltas[i] = Vec{};
    for (int tile = 0; tile < fast.padded; tile += kTile) {
      Vec sums[kTile] = {};
      add_product<Real>(to_outputs_.backward + std::ptrdiff_t(tile) * outputs_, outputs_, deltas,
                        sums);
#pragma GCC unroll 10
      for (int i = 0; i < kTile; ++i) group.deltas[row + tile + i] = sums[i];
    }
  }
  group.divergences[chunk] = divergence;
  if (!wants_gradients()) return;
  Real* sums = group.output_sums + chunk * output_sums();
  std::fill(sums, sums + output_sums(), Real(0));
  const Vec* sources = group.hidden + std::ptrdiff_t(begin + 1 - lag_) * width_ + fast.start;
  add_outer_products<Real>(scratch.deltas, outputs_, outputs_, sources, width_, fast.padded,
                           end - begin, sums);
  add_totals<Real>(scratch.deltas, outputs_, outputs_, end - begin,
                   sums + std::ptrdiff_t(outputs_) * fast.padded);
}

// The cross-entropy of one step; `deltas` are weight (y - y_bar).
template <typename Real>
Vector<Real> Pass<Real>::softmax(const Vec* potentials, const Vec* targets, Vec* deltas,
                                 const Vec& weight) const {
  const int units = problem_.softmax_units;
  Vec cross{};
  for (int value = 0; value < problem_.values; ++value) {
    Vec highest = potentials[0];
    for (int i = 1; i < units; ++i) highest = larger(highest, potentials[i]);
    Vec total{};
    for (int i = 0; i < units; ++i) {
      deltas[i] = exp_of(potentials[i] - highest);
      total += deltas[i];
    }
    const Vec share = Real(1) / total;
    const Vec log_total = highest + log_of(total);
    for (int i = 0; i < units; ++i) {
      cross += targets[i] * (log_total - potentials[i]);
      deltas[i] = weight * (deltas[i] * share - targets[i]);
    }
    potentials += units;
    targets += units;
    deltas += units;
  }
  return cross;
}

// --- backward ---

template <typename Real>
void Pass<Real>::scan_backward(Group& group) const {
  std::fill(group.sums, group.sums + group_sums_, Real(0));
  int end = group.steps + 1;
  for (int row = group.steps; row > 0; --row) {
    step_backward(group, row);
    if ((row - 1) % kChunk == 0) {
      sum_gradients(group, row, end);
      end = row;
    }
  }
  if (problem_.by_initial != nullptr) {
    step_backward(group, 0);
    give_initial(group);
  }
  if (problem_.by_drive != nullptr) give_drive(group);
  if (problem_.by_shift != nullptr) give_shift(group);
}

// deltas[row] = dE/dv: eq. (6), plus the paths within a step.
template <typename Real>
void Pass<Real>::step_backward(Group& group, int row) const {
  Vec* now = group.deltas + std::ptrdiff_t(row) * width_;
  const Vec* after = now + width_;
  const Vec* hidden = group.hidden + std::ptrdiff_t(row) * width_;
  for (int l = int(levels_.size()) - 1; l >= 0; --l) {
    const Level& level = levels_[l];
    const bool last = l + 1 == int(levels_.size());  // `outputs` left its contribution here
    for (int tile = 0; tile < level.padded; tile += kTile) {
      const int first = level.start + tile;
      Vec sums[kTile];
#pragma GCC unroll 10
      for (int i = 0; i < kTile; ++i) sums[i] = last ? now[first + i] : Vec{};
      for (const Connection<Real>& connection : connections_) {
        if (connection.from != l || (row == 0 && !connection.delayed)) continue;
        const Level& to = levels_[connection.to];
        add_product<Real>(connection.backward + std::ptrdiff_t(tile) * to.padded, to.padded,
                          (connection.delayed ? after : now) + to.start, sums);
      }
#pragma GCC unroll 10
      for (int i = 0; i < kTile; ++i) {
        const Vec h = hidden[first + i];
        now[first + i] = Real(level.keep) * after[first + i] + (Real(1) - h * h) * sums[i];
      }
    }
  }
}

// Adds the contribution of the rows first..end - 1 to the gradients of connections and biases.
template <typename Real>
void Pass<Real>::sum_gradients(const Group& group, int first, int end) const {
  const Vec* deltas = group.deltas + std::ptrdiff_t(first) * width_;
  for (const Connection<Real>& connection : connections_) {
    const Level& to = levels_[connection.to];
    const Level& from = levels_[connection.from];
    const Vec* sources = group.hidden + std::ptrdiff_t(first - connection.delayed) * width_;
    add_outer_products<Real>(deltas + to.start, width_, to.padded, sources + from.start, width_,
                             from.padded, end - first, group.sums + connection.sums);
  }
  add_totals<Real>(deltas, width_, width_, end - first, group.sums + group_sums_ - width_);
}

template <typename Real>
void Pass<Real>::give_initial(const Group& group) const {
  for (int lane = 0; lane < group.members; ++lane) {
    Real* given = problem_.by_initial + std::ptrdiff_t(group.member[lane]) * units_;
    for (const Level& level : levels_) {
      for (int i = 0; i < level.units; ++i) {
        given[level.first + i] = Real(kSlope) * group.deltas[level.start + i][lane];
      }
    }
  }
}

template <typename Real>
void Pass<Real>::give_drive(const Group& group) const {
  const Level& pfc = levels_.front();
  for (int lane = 0; lane < group.members; ++lane) {
    Real* given =
        problem_.by_drive + std::ptrdiff_t(group.member[lane]) * problem_.steps * pfc.units;
    for (int t = 0; t < problem_.steps; ++t) {
      const bool used = t + lag_ < group.steps;
      const Vec* deltas = group.deltas + std::ptrdiff_t(t + 1 + lag_) * width_ + pfc.start;
      for (int i = 0; i < pfc.units; ++i) {
        *given++ = used ? Real(pfc.scale) * deltas[i][lane] : Real(0);
      }
    }
  }
}

template <typename Real>
void Pass<Real>::give_shift(const Group& group) const {
  const Level& pfc = levels_.front();
  for (int i = 0; i < pfc.units; ++i) {
    const Vec total = total_delta(group, i);
    for (int lane = 0; lane < group.members; ++lane) {
      problem_.by_shift[std::ptrdiff_t(group.member[lane]) * pfc.units + i] =
          Real(pfc.scale) * total[lane];
    }
  }
}

// The sum of the deltas of a unit of the PFC over all steps with input from V_S.
template <typename Real>
Vector<Real> Pass<Real>::total_delta(const Group& group, int unit) const {
  const Vec* deltas = group.deltas + levels_.front().start + unit;
  Vec total{};
  for (int row = 1 + lag_; row <= group.steps; ++row) {
    total += deltas[std::ptrdiff_t(row) * width_];
  }
  return total;
}

// The gradient of the weights from V_S. Its activity is read where it lies, with neighbouring units
// side by side.
template <typename Real>
void Pass<Real>::inputs(const Group& group, int chunk, const Scratch& scratch) const {
  const Level& pfc = levels_.front();
  const int units = problem_.inputs;
  const int begin = std::max(chunk * kChunk, lag_);
  const int count = std::min((chunk + 1) * kChunk, group.steps) - begin;
  const int pitch = pfc.padded;
  for (int i = 0; i < count; ++i) {
    Real* arrays[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      arrays[lane] = scratch.rows + (std::ptrdiff_t(lane) * kChunk + i) * pitch;
    }
    scatter(group.deltas + std::ptrdiff_t(begin + i + 1) * width_ + pfc.start, pitch, arrays,
            group.members);
  }
  Real* sums = group.input_sums + chunk * input_sums();
  std::fill(sums, sums + input_sums(), Real(0));
  for (int lane = 0; lane < group.members; ++lane) {
    const int later = std::min(lane + 1, kLanes - 1);
    add_input_gradients(scratch.rows + std::ptrdiff_t(lane) * kChunk * pitch,
                        problem_.seen + (group.row[lane] + begin - lag_) * units, count,
                        problem_.seen + (group.row[later] + begin - lag_) * units, sums);
  }
  if (chunk == 0 && problem_.shift != nullptr) add_shift_gradients(group, scratch, sums);
}

// The contribution of the shift. It is the same at every step, so the sums of the deltas suffice.
template <typename Real>
void Pass<Real>::add_shift_gradients(const Group& group, const Scratch& scratch,
                                     Real* sums) const {
  const int pitch = levels_.front().padded;
  Real* arrays[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) arrays[lane] = scratch.rows + lane * pitch;
  for (int i = 0; i < pitch; ++i) scratch.potentials[i] = total_delta(group, i);
  scatter(scratch.potentials, pitch, arrays, group.members);
  for (int lane = 0; lane < group.members; ++lane) {
    const Real* shift = problem_.shift + std::ptrdiff_t(group.member[lane]) * problem_.inputs;
    add_input_gradients(arrays[lane], shift, 1, shift, sums);
  }
}

// sums[i][f] += sum over some steps of one sequence of deltas[step][i] seen[step][f]; prefetches
// `soon`, which is read next.
template <typename Real>
void Pass<Real>::add_input_gradients(const Real* deltas, const Real* seen, int steps,
                                     const Real* soon, Real* sums) const {
  const int rows = levels_.front().padded;
  const int units = problem_.inputs;
  int f = 0;
  for (; f + kWide * kLanes <= units; f += kWide * kLanes) {
    for (int t = 0; t < steps; ++t) {
      for (int v = 0; v < kWide; ++v) {
        __builtin_prefetch(soon + std::ptrdiff_t(t) * units + f + v * kLanes, 0, 2);
      }
    }
    for (int i = 0; i < rows; i += kSide) {
      add_rank_products<Real, kWide>(deltas + i, rows, seen + f, units, steps,
                                     sums + std::ptrdiff_t(i) * units + f);
    }
  }
  for (; f + kLanes <= units; f += kLanes) {
    for (int i = 0; i < rows; i += kSide) {
      add_rank_products<Real, 1>(deltas + i, rows, seen + f, units, steps,
                                 sums + std::ptrdiff_t(i) * units + f);
    }
  }
  for (; f < units; ++f) {
    for (int i = 0; i < rows; ++i) {
      for (int t = 0; t < steps; ++t) {
        sums[std::ptrdiff_t(i) * units + f] +=
            deltas[std::ptrdiff_t(t) * rows + i] * seen[std::ptrdiff_t(t) * units + f];
      }
    }
  }
}

// --- sums over all groups ---

// Adds the sums of all groups and chunks in an order that does not depend on the threads.
template <typename Real>
void Pass<Real>::add_up() const {
  double divergence = 0;
  for (const Group& group : groups_) {
    for (int chunk = 0; chunk < chunks(group); ++chunk) divergence += group.divergences[chunk];
  }
  *problem_.divergence = divergence * weight_;
  if (!wants_gradients()) return;
  Real* const* gradients = problem_.by_parameters;
  const Level& pfc = levels_.front();
  const Level& fast = levels_.back();
  const int outputs = problem_.values * problem_.softmax_units;
  for (const Group& group : groups_) {
    for (const Connection<Real>& connection : connections_) {
      const Level& to = levels_[connection.to];
      const Level& from = levels_[connection.from];
      add_scaled(group.sums + connection.sums, from.padded, to.units, from.units,
                 connection.scale, gradients[connection.parameter]);
    }
    const Real* by_biases = group.sums + group_sums_ - width_;
    for (std::size_t l = 0; l < levels_.size(); ++l) {
      add_scaled(by_biases + levels_[l].start, 0, 1, levels_[l].units, Real(levels_[l].scale),
                 gradients[biases_[l]]);
    }
    for (int chunk = 0; chunk < chunks(group); ++chunk) {
      const Real* sums = group.output_sums + chunk * output_sums();
      add_scaled(sums, fast.padded, outputs, fast.units, to_outputs_.scale,
                 gradients[to_outputs_.parameter]);
      add_scaled(sums + std::ptrdiff_t(outputs_) * fast.padded, 0, 1, outputs, Real(1),
                 gradients[output_bias_]);
      add_scaled(group.input_sums + chunk * input_sums(), problem_.inputs, pfc.units,
                 problem_.inputs, Real(pfc.scale), gradients[0]);
    }
  }
}

template <typename Real>
int compute(const CoreProblem<Real>* problem) {
  static thread_local Arena arena;
  try {
    Pass<Real>(*problem, arena).run();
  } catch (const std::bad_alloc&) {
    return 1;
  }
  return 0;
}

// Does `rounds` rounds of multiply-adds on registers alone; returns the floating point operations.
double multiply_add(long rounds) {
  constexpr int kChains = 12;  // enough to fill the pipelines of two units, and they fit the registers
  Vector<float> sums[kChains] = {};
  Vector<float> factor = Vector<float>{} + 0.999f;
  asm volatile("" : "+m"(factor));  // unknown to the compiler
  const Vector<float> x = factor;
  for (long round = 0; round < rounds; ++round) {
#pragma GCC unroll 16
    for (int i = 0; i < kChains; ++i) sums[i] = sums[i] * x + x;
  }
  for (int i = 1; i < kChains; ++i) sums[0] += sums[i];
  const volatile float used = sums[0][0];
  static_cast<void>(used);
  return 2.0 * kChains * Simd<float>::kLanes * double(rounds);
}

}  // namespace

extern "C" {

// The peak of the machine with `threads` threads: floating point operations per second.
double vmdnn_peak_flops(int threads) {
  const auto start = std::chrono::steady_clock::now();
  std::atomic<double> operations{0};
  run_in_threads(threads, [&operations](int) {
    const double done = multiply_add(2000000);
    for (double sum = operations; !operations.compare_exchange_weak(sum, sum + done);) {
    }
  });
  const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - start;
  return operations / taken.count();
}

int vmdnn_core_float(const CoreProblem<float>* problem) { return compute(problem); }

int vmdnn_core_double(const CoreProblem<double>* problem) { return compute(problem); }
}

}  // namespace vmdnn
