// Predicts every row of a log one step ahead, as a robot would while it moves.
//
//     follow MODEL [REPEATS] < LOG
//
// A line of the log is a time in s and one value per channel, separated by spaces; nan where a
// sensor did not report. Prints the prediction of each row before its values are used, exactly, and
// with REPEATS the median time of a step.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include "offbeat.hpp"

struct Row {
  double time;
  std::vector<double> values;
};

std::vector<Row> read(std::istream& in, size_t channels) {
  std::vector<Row> rows;
  for (std::string line, word; std::getline(in, line);) {
    std::istringstream words(line);
    std::vector<double> numbers;
    while (words >> word) numbers.push_back(std::strtod(word.c_str(), nullptr));
    if (numbers.size() != channels + 1)
      throw std::runtime_error("line " + std::to_string(rows.size() + 1) + " has " +
                               std::to_string(numbers.size()) + " numbers, expected a time and " +
                               std::to_string(channels) + " values");
    rows.push_back({numbers[0], {numbers.begin() + 1, numbers.end()}});
  }
  return rows;
}

int main(int count, char** arguments) try {
  if (count < 2) throw std::runtime_error("usage: follow MODEL [REPEATS] < LOG");
  offbeat::Stream stream(arguments[1]);
  const std::vector<Row> rows = read(std::cin, size_t(stream.channels()));
  std::vector<double> prediction(size_t(stream.channels()));
  for (const Row& row : rows) {
    stream.step(row.time, row.values.data(), prediction.data());
    for (double value : prediction) std::printf("%.17g ", value);
    std::printf("\n");
  }
  std::vector<double> taken;
  for (int i = 0; i < (count > 2 ? std::atoi(arguments[2]) : 0); ++i) {
    stream.reset();
    for (const Row& row : rows) {
      const auto start = std::chrono::steady_clock::now();
      stream.step(row.time, row.values.data(), prediction.data());
      taken.push_back(
          std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - start)
              .count());
    }
  }
  if (taken.empty()) return 0;
  std::nth_element(taken.begin(), taken.begin() + taken.size() / 2, taken.end());
  std::fprintf(stderr, "%s: median of %zu steps %.2f us\n", stream.instruction_set().c_str(),
               taken.size(), taken[taken.size() / 2]);
} catch (const std::exception& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 2;
}
