// VMDNN one step at a time, for acting: from an image to the outputs of M_O.
//
// `learner.network.numpy_network` computes the same in numpy; `learner.kernels.acting` calls this.
//
// A vector holds neighbouring units of one row of V_F or V_S, or of a level. The inputs of a row of
// units through one weight of a strided kernel lie `stride` values apart. So the columns of the
// subnet below are first sorted by their remainder; then these inputs lie side by side.

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <new>
#include <utility>
#include <vector>

#include "vectors.h"

namespace vmdnn {
namespace {

typedef Vector<float> Vec;
constexpr int kLanes = Simd<float>::kLanes;
constexpr int kMaps = 3;  // maps of which a row is computed at once; their sums fit in registers

// Description of a network, which `learner.kernels.acting` fills in.

struct MapsShape {
  std::int32_t maps, height, width, kernel_height, kernel_width, stride;
  float leak;  // 1 / tau
};

struct LevelShape {
  std::int32_t units;
  float leak;
};

struct Description {
  std::int32_t image_height, image_width;
  MapsShape maps[2];      // V_F, V_S
  LevelShape levels[3];   // PFC, M_S, M_F
  std::int32_t values, softmax_units;
  std::int32_t literal;   // the update order in which eq. (1) is printed
  const float* parameters;  // one after the other, ordered as `learner.kernels.acting` says
};

constexpr int rounded_up(int count, int unit) { return (count + unit - 1) / unit * unit; }

constexpr int whole_vectors(int count) { return rounded_up(count, kLanes); }

// Reads parameters one after the other.
class Reader {
 public:
  explicit Reader(const float* next) : next_(next) {}

  const float* take(std::ptrdiff_t count) {
    next_ += count;
    return next_ - count;
  }

  std::vector<float> take(int count, int padded) {
    std::vector<float> values(padded);
    std::copy_n(take(count), count, values.begin());
    return values;
  }

 private:
  const float* next_;
};

// One step of leaky integrators, eq. (1) and (2): changes the potentials, returns the activity.
inline Vec integrate(float* potentials, const Vec& drive, float leak) {
  const Vec before = load(potentials);
  const Vec now = before + leak * (drive - before);
  store(potentials, now);
  return float(kGain) * tanh_of(float(kSlope) * now);
}

// ---------------------------------------------------------------------------------------------
// V_F and V_S

class Maps {
 public:
  Maps(const MapsShape& shape, int maps_below, int height_below, int width_below, Reader& reader)
      : shape_(shape),
        rows_below_(maps_below * height_below),
        width_below_(width_below),
        pitch_((width_below + shape.stride - 1) / shape.stride),
        taps_(maps_below * shape.kernel_height * shape.kernel_width),
        // rows are read in whole vectors, beyond their ends
        below_(std::ptrdiff_t(shape.stride) * rows_below_ * pitch_ + 2 * kLanes),
        potentials_(std::ptrdiff_t(shape.maps) * shape.height * whole_vectors(shape.width)) {
    for (int map = 0; map < maps_below; ++map) {
      for (int row = 0; row < shape.kernel_height; ++row) {
        for (int column = 0; column < shape.kernel_width; ++column) {
          const int phase = column % shape.stride;
          offsets_.push_back((phase * rows_below_ + map * height_below + row) * pitch_ +
                             column / shape.stride);
        }
      }
    }
    pack(reader.take(std::ptrdiff_t(shape.maps) * taps_));
    biases_ = reader.take(shape.maps, rounded_up(shape.maps, kMaps));
  }

  int units() const { return shape_.maps * shape_.height * shape_.width; }

  void reset() { std::fill(potentials_.begin(), potentials_.end(), 0.0f); }

  // Both arrays are (maps, height, width).
  void step(const float* below, float* activity) {
    sort_columns(below);
    const int pitch = whole_vectors(shape_.width);
    for (int map = 0; map < shape_.maps; map += kMaps) {
      for (int row = 0; row < shape_.height; ++row) {
        for (int column = 0; column < shape_.width; column += 2 * kLanes) {
          const bool two = column + kLanes < shape_.width;
          two ? part_of_row<2>(map, row, column, pitch, activity)
              : part_of_row<1>(map, row, column, pitch, activity);
        }
      }
    }
  }

 private:
  // Weights (maps, taps) as (maps / kMaps, taps, kMaps).
  void pack(const float* weights) {
    weights_.resize(std::ptrdiff_t(rounded_up(shape_.maps, kMaps)) * taps_);
    for (int map = 0; map < shape_.maps; ++map) {
      float* packed = weights_.data() + std::ptrdiff_t(map / kMaps) * kMaps * taps_ + map % kMaps;
      for (int tap = 0; tap < taps_; ++tap) packed[tap * kMaps] = *weights++;
    }
  }

  // Fills below_ (stride, rows, pitch): column x becomes column x / stride of its remainder.
  void sort_columns(const float* below) {
    for (int row = 0; row < rows_below_; ++row, below += width_below_) {
      for (int phase = 0; phase < shape_.stride; ++phase) {
        float* sorted = below_.data() + std::ptrdiff_t(phase * rows_below_ + row) * pitch_;
        for (int x = phase; x < width_below_; x += shape_.stride) *sorted++ = below[x];
      }
    }
  }

  // Computes kVectors vectors of row `row`, from `column` on, of kMaps maps, from `map` on.
  template <int kVectors>
  void part_of_row(int map, int row, int column, int pitch, float* activity) {
    Vec sums[kMaps][kVectors];
    for (int i = 0; i < kMaps; ++i) {
      for (int v = 0; v < kVectors; ++v) sums[i][v] = Vec{} + biases_[map + i];
    }
    const float* seen = below_.data() + std::ptrdiff_t(row) * shape_.stride * pitch_ + column;
    const float* weights = weights_.data() + std::ptrdiff_t(map) * taps_;
    for (int tap = 0; tap < taps_; ++tap, weights += kMaps) {
      for (int v = 0; v < kVectors; ++v) {
        const Vec x = load(seen + offsets_[tap] + v * kLanes);
        for (int i = 0; i < kMaps; ++i) sums[i][v] += weights[i] * x;
      }
    }
    for (int i = 0; i < std::min(kMaps, shape_.maps - map); ++i) {
      const std::ptrdiff_t line = std::ptrdiff_t(map + i) * shape_.height + row;
      for (int v = 0; v < kVectors; ++v) {
        const int start = column + v * kLanes;
        const Vec now =
            integrate(potentials_.data() + line * pitch + start, sums[i][v], shape_.leak);
        std::memcpy(activity + line * shape_.width + start, &now,
                    sizeof(float) * std::min(kLanes, shape_.width - start));
      }
    }
  }

  MapsShape shape_;
  int rows_below_, width_below_;
  int pitch_;  // of below_
  int taps_;   // weights of one unit
  std::vector<std::int32_t> offsets_;  // index in below_ of each tap of the first unit
  std::vector<float> weights_, biases_;
  std::vector<float> below_, potentials_;
};

// ---------------------------------------------------------------------------------------------
// The recurrent core

// Weights (units, sources) as (sources, whole vectors of units).
class Weights {
 public:
  Weights(int units, int sources, Reader& reader)
      : sources_(sources), pitch_(whole_vectors(units)), packed_(std::ptrdiff_t(pitch_) * sources) {
    const float* weights = reader.take(std::ptrdiff_t(units) * sources);
    for (int unit = 0; unit < units; ++unit) {
      for (int k = 0; k < sources; ++k) packed_[std::ptrdiff_t(k) * pitch_ + unit] = *weights++;
    }
  }

  // Input of the vector of units from `unit` on for this activity of the sources.
  Vec product(int unit, const float* activity) const {
    const float* weights = packed_.data() + unit;
    Vec sum{};
    for (int k = 0; k < sources_; ++k, weights += pitch_) sum += load(weights) * activity[k];
    return sum;
  }

 private:
  int sources_, pitch_;
  std::vector<float> packed_;
};

class Level {
 public:
  Level(const LevelShape& shape, int below, int above, Reader& reader)
      : leak_(shape.leak),
        input_(shape.units, below, reader),
        recurrent_(shape.units, shape.units, reader),
        feedback_(shape.units, above, reader),
        biases_(reader.take(shape.units, whole_vectors(shape.units))),
        potentials_(biases_.size()) {}

  void reset() { std::fill(potentials_.begin(), potentials_.end(), 0.0f); }

  void step(const float* below, const float* own, const float* above, float* activity) {
    for (int unit = 0; unit < int(biases_.size()); unit += kLanes) {
      const Vec drive = input_.product(unit, below) + recurrent_.product(unit, own) +
                        feedback_.product(unit, above) + load(biases_.data() + unit);
      store(activity + unit, integrate(potentials_.data() + unit, drive, leak_));
    }
  }

 private:
  float leak_;
  Weights input_, recurrent_, feedback_;
  std::vector<float> biases_, potentials_;
};

// Softmax for each value over its units, in place; `potentials` is padded to whole vectors.
void softmax(float* potentials, int values, int units) {
  for (int value = 0; value < values; ++value) {
    float* own = potentials + value * units;
    const float highest = *std::max_element(own, own + units);
    for (int i = 0; i < units; ++i) own[i] -= highest;
  }
  for (int i = 0; i < whole_vectors(values * units); i += kLanes) {
    store(potentials + i, exp_of(load(potentials + i)));
  }
  for (int value = 0; value < values; ++value) {
    float* own = potentials + value * units;
    float total = 0;
    for (int i = 0; i < units; ++i) total += own[i];
    for (int i = 0; i < units; ++i) own[i] /= total;
  }
}

class Network {
 public:
  explicit Network(const Description& description)
      : Network(description, Reader(description.parameters)) {}

  int features() const { return slow_.units(); }

  // Activity of the PFC after the last call of act.
  void pfc(float* activity) const { std::copy_n(before_[1].begin(), pfc_units_, activity); }

  void reset() {
    fast_.reset();
    slow_.reset();
    for (Level& level : levels_) level.reset();
    for (std::vector<float>& activity : before_) std::fill(activity.begin(), activity.end(), 0.0f);
  }

  // Computes the activity of V_S for the image of this step.
  void see(const float* image, float* seen) {
    fast_.step(image, fast_activity_.data());
    slow_.step(fast_activity_.data(), seen);
  }

  // Computes the outputs (values, softmax units) for the activity of V_S of this step.
  void act(const float* seen, float* outputs) {
    std::copy_n(seen, features(), now_[0].begin());
    const auto& source = literal_ ? before_ : now_;
    for (int l = 0; l < 3; ++l) {
      levels_[l].step(source[l].data(), before_[l + 1].data(), before_[l + 2].data(),
                      now_[l + 1].data());
    }
    for (int unit = 0; unit < int(potentials_.size()); unit += kLanes) {
      store(potentials_.data() + unit,
            output_weights_.product(unit, source[3].data()) + load(output_biases_.data() + unit));
    }
    softmax(potentials_.data(), values_, softmax_units_);
    std::copy_n(potentials_.begin(), values_ * softmax_units_, outputs);
    std::swap(before_, now_);
  }

 private:
  Network(const Description& d, Reader reader)
      : literal_(d.literal),
        values_(d.values),
        softmax_units_(d.softmax_units),
        pfc_units_(d.levels[0].units),
        fast_(d.maps[0], 1, d.image_height, d.image_width, reader),
        slow_(d.maps[1], d.maps[0].maps, d.maps[0].height, d.maps[0].width, reader),
        levels_{Level(d.levels[0], slow_.units(), d.levels[1].units, reader),
                Level(d.levels[1], d.levels[0].units, d.levels[2].units, reader),
                Level(d.levels[2], d.levels[1].units, 0, reader)},
        output_weights_(d.values * d.softmax_units, d.levels[2].units, reader),
        fast_activity_(fast_.units()),
        potentials_(whole_vectors(d.values * d.softmax_units)) {
    output_biases_ = reader.take(d.values * d.softmax_units, int(potentials_.size()));
    before_[0].resize(slow_.units());
    for (int l = 0; l < 3; ++l) before_[l + 1].resize(whole_vectors(d.levels[l].units));
    std::copy(std::begin(before_), std::end(before_), std::begin(now_));
  }

  bool literal_;
  int values_, softmax_units_, pfc_units_;
  Maps fast_, slow_;
  Level levels_[3];
  Weights output_weights_;
  std::vector<float> output_biases_;
  std::vector<float> fast_activity_, potentials_;
  // Activity of V_S, PFC, M_S and M_F one step before and now; the fifth stays empty, since M_F has
  // no level above.
  std::vector<float> before_[5], now_[5];
};

}  // namespace

extern "C" {

// Returns null if there is no memory.
Network* vmdnn_acting_new(const Description* description) {
  try {
    return new Network(*description);
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}

void vmdnn_acting_free(Network* network) { delete network; }

void vmdnn_acting_reset(Network* network) { network->reset(); }

void vmdnn_acting_see(Network* network, const float* image, float* seen) {
  network->see(image, seen);
}

void vmdnn_acting_act(Network* network, const float* seen, float* outputs) {
  network->act(seen, outputs);
}

void vmdnn_acting_pfc(const Network* network, float* activity) { network->pfc(activity); }
}

}  // namespace vmdnn
