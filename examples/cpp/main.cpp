// complete MODEL.onnx SCAN.{pcd,bin} OUT.pcd [FULL]: completes a scan and prints milliseconds.
//
// FULL is the value of full reflectance in the scan, such as 255. SCAN is a PCD with fields x, y, z and intensity,
// ASCII or binary, or rows of four float32 as KITTI's .bin. OUT has x, y, z, intensity and measured.

#include <chrono>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <map>
#include <sstream>
#include <stdexcept>

#include "completer.hpp"

namespace {

struct Field {
  size_t offset, column;
  char type;
  int size;
};

double number(const char* at, char type, int size) {
  const auto as = [at](auto value) {
    std::memcpy(&value, at, sizeof value);
    return static_cast<double>(value);
  };
  if (type == 'F') return size == 8 ? as(double{}) : as(float{});
  if (type == 'U') return size == 1 ? as(uint8_t{}) : size == 2 ? as(uint16_t{}) : as(uint32_t{});
  return size == 1 ? as(int8_t{}) : size == 2 ? as(int16_t{}) : as(int32_t{});
}

std::vector<Point> read_pcd(std::istream& file) {
  std::map<std::string, std::vector<std::string>> header;
  std::string line, key;
  while (!header.count("DATA") && std::getline(file, line)) {
    std::istringstream words(line);
    if (words >> key && key[0] != '#') header[key] = {std::istream_iterator<std::string>(words), {}};
  }
  const auto& names = header["FIELDS"];
  const auto& sizes = header["SIZE"];
  const auto& types = header["TYPE"];
  if (header["DATA"].empty() || header["POINTS"].empty() || names.empty() || sizes.size() != names.size() ||
      types.size() != names.size())
    throw std::runtime_error("no PCD header");
  std::map<std::string, Field> fields;
  size_t step = 0, column = 0;
  for (size_t i = 0; i < names.size(); ++i) {
    const size_t count = i < header["COUNT"].size() ? std::stoul(header["COUNT"][i]) : 1;
    fields[names[i]] = {step, column, types[i][0], std::stoi(sizes[i])};
    step += count * std::stoul(sizes[i]);
    column += count;
  }
  for (const auto* axis : {"x", "y", "z"})
    if (!fields.count(axis)) throw std::runtime_error(std::string("no field ") + axis);
  const bool text = header["DATA"][0] == "ascii";
  if (!text && header["DATA"][0] != "binary")
    throw std::runtime_error("DATA " + header["DATA"][0] + ": convert it by pcl_convert_pcd_ascii_binary");
  std::vector<char> row(step);
  std::vector<Point> points;
  for (size_t left = std::stoull(header["POINTS"][0]); left > 0; --left) {
    std::vector<std::string> words;
    if (text) {
      if (!std::getline(file, line)) throw std::runtime_error("fewer points than its header says");
      std::istringstream all(line);
      words = {std::istream_iterator<std::string>(all), {}};
      if (words.size() < column) throw std::runtime_error("a line with too few numbers");
    } else if (!file.read(row.data(), step)) {
      throw std::runtime_error("fewer points than its header says");
    }
    const auto value = [&](const char* name) {
      const auto found = fields.find(name);
      if (found == fields.end()) return 0.0f;
      const auto& [offset, place, type, size] = found->second;
      return static_cast<float>(text ? std::stod(words[place]) : number(row.data() + offset, type, size));
    };
    points.push_back({value("x"), value("y"), value("z"), value("intensity")});
  }
  return points;
}

std::vector<Point> read(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error("cannot be read");
  if (path.size() > 4 && path.substr(path.size() - 4) == ".pcd") return read_pcd(file);
  const std::string bytes{std::istreambuf_iterator<char>(file), {}};
  if (bytes.size() % sizeof(Point)) throw std::runtime_error("no rows of four float32");
  std::vector<Point> points(bytes.size() / sizeof(Point));
  std::memcpy(points.data(), bytes.data(), bytes.size());
  return points;
}

void write(const std::string& path, const Completed& scan, float full) {
  const auto count = std::to_string(scan.points.size());
  std::ofstream file(path, std::ios::binary);
  file << "VERSION 0.7\nFIELDS x y z intensity measured\nSIZE 4 4 4 4 1\nTYPE F F F F U\nCOUNT 1 1 1 1 1\n"
       << "WIDTH " << count << "\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS " << count << "\nDATA binary\n";
  for (size_t i = 0; i < scan.points.size(); ++i) {
    Point point = scan.points[i];
    point.reflectance *= full;
    file.write(reinterpret_cast<const char*>(&point), sizeof point);
    file.put(static_cast<char>(scan.measured[i]));
  }
  if (!file.flush()) throw std::runtime_error("cannot be written");
}

}  // namespace

int main(int count, char** words) {
  if (count < 4) {
    std::cerr << "usage: complete MODEL.onnx SCAN.{pcd,bin} OUT.pcd [FULL]\n";
    return 2;
  }
  std::string at = words[1];
  try {
    Completer complete(at);
    at = words[2];
    auto points = read(at);
    const float full = count > 4 ? std::stof(words[4]) : 1.0f;
    for (auto& point : points) point.reflectance /= full;
    for (int round = 0; round < 3; ++round) {  // the first run reserves memory
      const auto start = std::chrono::steady_clock::now();
      const auto scan = complete(points);
      const auto took = std::chrono::steady_clock::now() - start;
      const auto ms = std::chrono::duration_cast<std::chrono::milliseconds>(took).count();
      std::cout << points.size() << " points to " << scan.points.size() << " in " << ms << " ms\n";
      if (round == 2) write(at = words[3], scan, full);
    }
  } catch (const std::exception& error) {
    std::cerr << at << ": " << error.what() << "\n";
    return 2;
  }
}
