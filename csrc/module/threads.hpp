// The memory of a call, and its work spread over threads: part of module.cpp and
// library/stream.cpp.

// Bytes of memory that this machine has. No buffer may be larger.
int64_t memory_limit() {
  const int64_t pages = sysconf(_SC_PHYS_PAGES), size = sysconf(_SC_PAGE_SIZE);
  return pages > 0 && size > 0 ? pages * size : int64_t(1) << 40;
}

// Sums and products of sizes; INT64_MAX where the result is larger.
int64_t plus(int64_t a, int64_t b) {
  int64_t sum;
  return __builtin_add_overflow(a, b, &sum) ? INT64_MAX : sum;
}
int64_t times(int64_t a, int64_t b) {
  int64_t product;
  return __builtin_mul_overflow(a, b, &product) ? INT64_MAX : product;
}

// A buffer of `n` numbers, aligned to a cache line, not initialised.
template <class T>
class Buffer {
 public:
  Buffer(const char* name, int64_t n) {
    const int64_t limit = memory_limit();
    if (n < 0 || n > limit / int64_t(sizeof(T)))
      refuse(
          std::string(name) + " would need " + std::to_string(n) + " numbers of " +
          std::to_string(sizeof(T)) + " bytes, but this machine has " + std::to_string(limit) +
          " bytes of memory; use fewer solver steps per gap, a smaller model or a smaller batch");
    data_ = static_cast<T*>(
        ::operator new(size_t(std::max<int64_t>(n, 1)) * sizeof(T), std::align_val_t(64)));
  }
  ~Buffer() { ::operator delete(data_, std::align_val_t(64)); }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  T* get() const { return data_; }

 private:
  T* data_ = nullptr;
};

// Calls work(task, scratch) for each task. The result does not depend on the number of threads.
template <class T, class Work>
void spread(int64_t tasks, int threads, int64_t scratch, const Work& work) {
  threads = int(std::min<int64_t>(std::max(threads, 1), tasks));
  const int64_t line = 64 / int64_t(sizeof(T)), each = plus(scratch, line - 1) / line * line;
  const Buffer<T> scratches("the scratch memory", times(each, threads));
  std::atomic<int64_t> next{0};
  auto run = [&](int thread) {
    for (int64_t task = next++; task < tasks; task = next++)
      work(task, scratches.get() + thread * each);
  };
  std::vector<std::thread> others;
  others.reserve(size_t(threads));
  for (int i = 1; i < threads; ++i) {
    try {
      others.emplace_back(run, i);
    } catch (const std::system_error&) {
      break;  // the system gives no more threads: those that run take all tasks
    }
  }
  run(0);
  for (std::thread& t : others) t.join();
}

// The rows of a block, or of a slot of blocks, in order.
struct BlockRun {
  int rows, cost;  // cost of one row
};

// Calls work(run, begin, end, scratch) until each run has computed all its rows. With several
// threads, rows are computed in chunks, and the run with the most work left goes first, so that the
// threads end at the same time even if the number of blocks is not a multiple of theirs. The result
// does not depend on which thread computes which chunk.
template <class T, class Work>
void run_chunks(const std::vector<BlockRun>& runs, int chunk, int threads, int64_t scratch,
                const Work& work) {
  const int64_t n = int64_t(runs.size());
  if (threads < 2 || n < 2 || n > 8 * int64_t(threads)) {
    spread<T>(n, threads, scratch,
              [&](int64_t i, T* memory) { work(int(i), 0, runs[i].rows, memory); });
    return;
  }
  std::mutex mutex;
  std::vector<int> done(n, 0);
  std::vector<bool> taken(n, false);
  spread<T>(std::min<int64_t>(threads, n), threads, scratch, [&](int64_t, T* memory) {
    int mine = -1, begin = 0, end = 0;
    for (;;) {
      {
        std::lock_guard<std::mutex> lock(mutex);
        if (mine >= 0) {
          done[mine] = end;
          taken[mine] = end >= runs[mine].rows;
        }
        int64_t most = -1;
        mine = -1;
        for (int64_t i = 0; i < n; ++i) {
          const int64_t left = int64_t(runs[i].rows - done[i]) * runs[i].cost;
          if (!taken[i] && left > most) most = left, mine = int(i);
        }
        if (mine < 0) return;  // other threads compute what is left
        taken[mine] = true;
        begin = done[mine];
        end = int(std::min<int64_t>(runs[mine].rows, int64_t(begin) + chunk));
      }
      work(mine, begin, end, memory);
    }
  });
}
