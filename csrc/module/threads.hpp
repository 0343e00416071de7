// Memory of a call, and work spread over threads: part of module.cpp.

template <class T>
class Buffer {  // aligned to a cache line, not initialised
 public:
  explicit Buffer(int64_t n)
      : data_(static_cast<T*>(
            ::operator new(size_t(std::max<int64_t>(n, 1)) * sizeof(T), std::align_val_t(64)))) {}
  ~Buffer() { ::operator delete(data_, std::align_val_t(64)); }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  T* get() const { return data_; }

 private:
  T* data_;
};

// Calls work(task, scratch) for each task; which thread takes which does not matter to the result.
template <class T, class Work>
void spread(int64_t tasks, int threads, int64_t scratch, const Work& work) {
  threads = int(std::min<int64_t>(std::max(threads, 1), tasks));
  std::vector<std::unique_ptr<Buffer<T>>> scratches;
  for (int i = 0; i < threads; ++i) scratches.push_back(std::make_unique<Buffer<T>>(scratch));
  std::atomic<int64_t> next{0};
  auto run = [&](int thread) {
    for (int64_t task = next++; task < tasks; task = next++) work(task, scratches[thread]->get());
  };
  std::vector<std::thread> others;
  for (int i = 1; i < threads; ++i) {
    try {
      others.emplace_back(run, i);
    } catch (const std::system_error&) {
      break;  // no more threads to be had: those that run take all tasks
    }
  }
  run(0);
  for (std::thread& t : others) t.join();
}

// A walk over the rows of a block, or of a slot of blocks.
struct BlockRun {
  int rows, cost;  // of a row
};

// Calls work(walk, begin, end, scratch) until each walk has got from 0 to its last row. With
// several threads it is done in stretches, the walk with most before it first, so that all end
// together although the blocks may not be a multiple of the threads. Which thread takes which
// chunk does not matter to the result.
template <class T, class Work>
void run_chunks(const std::vector<BlockRun>& runs, int chunk, int threads, int64_t scratch,
                const Work& work) {
  const int64_t n = int64_t(runs.size());
  if (threads < 2 || n < 2 || n > 8 * threads) {
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
        // What is left is in the hands of others, who go on until it is done.
        if (mine < 0) return;
        taken[mine] = true;
        begin = done[mine];
        end = std::min(runs[mine].rows, begin + chunk);
      }
      work(mine, begin, end, memory);
    }
  });
}
