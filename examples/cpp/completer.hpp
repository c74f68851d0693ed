// Completes LiDAR scans by a file of `r2flow export densify_small --from SENSOR`.
#pragma once

#include <onnxruntime_cxx_api.h>

#include <cstdint>
#include <string>
#include <vector>

struct Point {
  float x, y, z;      // metres: ahead, left, up
  float reflectance;  // of [0, 1]; throughout 0 if unknown
};

struct Completed {
  std::vector<Point> points;
  std::vector<uint8_t> measured;  // 1: a point of the input, unchanged; 0: added
};

class Completer {
 public:
  // Threads: 1 takes a core, 0 takes all.
  explicit Completer(const std::string& model, int threads = 1)
      : session_(environment_, model.c_str(), options(threads)) {}

  Completed operator()(std::vector<Point>& points) {
    static_assert(sizeof(Point) == 4 * sizeof(float));
    const int64_t shape[] = {static_cast<int64_t>(points.size()), 4};
    auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    auto input = Ort::Value::CreateTensor<float>(
        memory, reinterpret_cast<float*>(points.data()), 4 * points.size(), shape, 2);
    const char* inputs[] = {"points"};
    const char* outputs[] = {"completed", "measured"};
    auto found = session_.Run(Ort::RunOptions{}, inputs, &input, 1, outputs, 2);

    const auto count = found[0].GetTensorTypeAndShapeInfo().GetShape()[0];
    const auto* first = reinterpret_cast<const Point*>(found[0].GetTensorData<float>());
    const auto* measured = found[1].GetTensorData<bool>();
    return {{first, first + count}, {measured, measured + count}};
  }

 private:
  static Ort::SessionOptions options(int threads) {
    Ort::SessionOptions made;
    made.SetIntraOpNumThreads(threads);
    return made;
  }

  Ort::Env environment_{ORT_LOGGING_LEVEL_WARNING, "r2flow"};
  Ort::Session session_;
};
