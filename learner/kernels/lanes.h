// Conversion between vectors with one array in each lane and arrays that lie one after the other.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <new>
#include <utility>

#ifdef __linux__
#include <sys/mman.h>
#endif

#include "vectors.h"

namespace vmdnn {

// The 2 x 2 blocks of size kStep in (a; b), transposed: a keeps its first and gets b's first.
template <int kStep, typename Vec, int... kLane>
inline void exchange(Vec& a, Vec& b, std::integer_sequence<int, kLane...>) {
  constexpr int kLanes = sizeof...(kLane);
  const Vec first = __builtin_shufflevector(
      a, b, (kLane & kStep ? kLanes + kLane - kStep : kLane)...);
  const Vec second = __builtin_shufflevector(
      a, b, (kLane & kStep ? kLanes + kLane : kLane + kStep)...);
  a = first;
  b = second;
}

template <typename Real, int kStep>
inline void transpose_from(Vector<Real>* square) {
  constexpr int kLanes = Simd<Real>::kLanes;
  if constexpr (kStep < kLanes) {
#pragma GCC unroll 16
    for (int row = 0; row < kLanes; ++row) {
      if ((row & kStep) == 0) {
        exchange<kStep>(square[row], square[row + kStep],
                        std::make_integer_sequence<int, kLanes>());
      }
    }
    transpose_from<Real, 2 * kStep>(square);
  }
}

// Lane j of vector i becomes lane i of vector j.
template <typename Real>
inline void transpose(Vector<Real>* square) {
  transpose_from<Real, 1>(square);
}

// Lane i of the result is the sum of the lanes of vector i. The vectors are overwritten.
template <typename Real, int kStep = 1>
inline Vector<Real> sums_of_lanes(Vector<Real>* square) {
  constexpr int kLanes = Simd<Real>::kLanes;
  if constexpr (kStep == kLanes) {
    return square[0];
  } else {
#pragma GCC unroll 16
    for (int row = 0; row < kLanes; row += 2 * kStep) {
      exchange<kStep>(square[row], square[row + kStep], std::make_integer_sequence<int, kLanes>());
      square[row] += square[row + kStep];
    }
    return sums_of_lanes<Real, 2 * kStep>(square);
  }
}

// Reads kLanes arrays of `count` values into `count` vectors, one array in each lane.
template <typename Real>
inline void gather(const Real* const* arrays, int count, Vector<Real>* vectors) {
  constexpr int kLanes = Simd<Real>::kLanes;
  if (count < kLanes) {
    for (int i = 0; i < count; ++i) {
      for (int lane = 0; lane < kLanes; ++lane) vectors[i][lane] = arrays[lane][i];
    }
    return;
  }
  for (int next = 0; next < count; next += kLanes) {
    const int start = std::min(next, count - kLanes);  // the last block may overlap the previous
    Vector<Real> square[kLanes];
#pragma GCC unroll 16
    for (int lane = 0; lane < kLanes; ++lane) square[lane] = load(arrays[lane] + start);
    transpose<Real>(square);
#pragma GCC unroll 16
    for (int i = 0; i < kLanes; ++i) vectors[start + i] = square[i];
  }
}

// Writes the first `members` lanes of `count` vectors to arrays.
template <typename Real>
inline void scatter(const Vector<Real>* vectors, int count, Real* const* arrays, int members) {
  constexpr int kLanes = Simd<Real>::kLanes;
  if (count < kLanes) {
    for (int i = 0; i < count; ++i) {
      for (int lane = 0; lane < members; ++lane) arrays[lane][i] = vectors[i][lane];
    }
    return;
  }
  for (int next = 0; next < count; next += kLanes) {
    const int start = std::min(next, count - kLanes);
    Vector<Real> square[kLanes];
#pragma GCC unroll 16
    for (int i = 0; i < kLanes; ++i) square[i] = vectors[start + i];
    transpose<Real>(square);
    for (int lane = 0; lane < members; ++lane) store(arrays[lane] + start, square[lane]);
  }
}

// Memory that a thread keeps from call to call; new pages would cost more than the arithmetic.

class Arena {
 public:
  ~Arena() { std::free(memory_); }

  // Provides memory for everything that take_memory() gets from `take`. It is called twice: first to
  // count, when `take` returns no usable memory. Memory taken earlier becomes invalid.
  template <typename Function>
  void allocate(const Function& take_memory) {
    used_ = 0;
    take_memory();
    reserve();
    take_memory();
  }

  template <typename Value>
  Value* take(std::size_t count) {
    const auto address = reinterpret_cast<std::uintptr_t>(memory_) + used_;
    used_ += (count * sizeof(Value) + kLine - 1) / kLine * kLine;
    return reinterpret_cast<Value*>(address);
  }

 private:
  void reserve() {
    const std::size_t bytes = used_;
    used_ = 0;
    if (bytes <= size_) return;
    std::free(memory_);
    size_ = (bytes + kPage - 1) / kPage * kPage;
    memory_ = static_cast<char*>(std::aligned_alloc(kPage, size_));
    if (memory_ == nullptr) {
      size_ = 0;
      throw std::bad_alloc();
    }
#ifdef __linux__
    madvise(memory_, size_, MADV_HUGEPAGE);
#endif
  }

  static constexpr std::size_t kLine = 64;
  static constexpr std::size_t kPage = std::size_t(1) << 21;
  char* memory_ = nullptr;
  std::size_t size_ = 0;
  std::size_t used_ = 0;
};

}  // namespace vmdnn
