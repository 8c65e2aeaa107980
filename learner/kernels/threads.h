// Threads that may fail to start.

#pragma once

#include <exception>
#include <thread>
#include <vector>

namespace vmdnn {

// Calls work(0), ..., work(count - 1), each in a thread of its own, and work(0) in the calling one.
// Where a thread cannot be started (a limit on processes, no memory), the calling thread does its
// work after work(0). `work` must not throw.
template <typename Work>
void run_in_threads(int count, const Work& work) {
  std::vector<std::thread> threads;
  int started = 1;
  try {
    threads.reserve(count);
    for (; started < count; ++started) threads.emplace_back(work, started);
  } catch (const std::exception&) {
  }
  work(0);
  for (int rest = started; rest < count; ++rest) work(rest);
  for (std::thread& thread : threads) thread.join();
}

}  // namespace vmdnn
