// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// Closed-loop torques and accelerations of one machine: Pinocchio and the exported C, in turns.
//
// The tree and its loops come as numbers from pinocchio_c.py. Inverse dynamics close the loops by
// Newton's method from the sample before, and project rnea's torques on the actuated joints.
// Accelerations of efforts are those of constraintDynamics, where all loops close in points.
#include <algorithm>
#include <ctime>
#include <fstream>
#include <iostream>
#include <vector>

#include <pinocchio/fwd.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/spatial.hpp>
#include <pinocchio/algorithm/constrained-dynamics.hpp>
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>

#include <dlfcn.h>

using namespace pinocchio;
using Eigen::MatrixXd;
using Eigen::Vector3d;
using Eigen::VectorXd;

static double now()
{
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}

static VectorXd numbers(std::istream & in, int count)
{
  VectorXd values(count);
  for (int k = 0; k < count; k++) in >> values[k];
  return values;
}

static SE3 placement(std::istream & in)
{
  const VectorXd v = numbers(in, 12);
  Eigen::Matrix3d turned;
  turned << v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8];
  return SE3(turned, v.tail(3));
}

struct Point { FrameIndex a, b; };
struct Angle { FrameIndex a, b; Vector3d x, y; double cosine; };

struct Loops
{
  Model model;
  Data data;
  std::vector<Point> points;
  std::vector<Angle> angles;
  std::vector<int> actuated, passive, kept;
  VectorXd q, v, a;
  MatrixXd all, jp, ja, left, right;
  VectorXd error, drift;
  Eigen::PartialPivLU<MatrixXd> lu;
  std::vector<RigidConstraintModel> constraints;
  std::vector<RigidConstraintData> held;
  ProximalSettings settings{1e-12, 1e-10, 20};
  int named = 0;

  FrameIndex frame(std::istream & in, bool whole)
  {
    JointIndex joint;
    in >> joint;
    SE3 at = SE3::Identity();
    if (whole) at.translation() = numbers(in, 3);
    return model.addFrame(Frame("f" + std::to_string(named++), joint, 0, at, OP_FRAME));
  }

  explicit Loops(std::istream & in)
  {
    int joints, inertias, count;
    in >> joints;
    for (int k = 0; k < joints; k++) {
      JointIndex parent;
      std::string kind;
      in >> parent >> kind;
      const SE3 at = placement(in);
      const std::string name = "j" + std::to_string(k);
      if (kind == "R") model.addJoint(parent, JointModelRZ(), at, name);
      else model.addJoint(parent, JointModelPZ(), at, name);
    }
    in >> inertias;
    for (int k = 0; k < inertias; k++) {
      JointIndex joint;
      in >> joint;
      const VectorXd v = numbers(in, 13);
      Eigen::Matrix3d about;
      about << v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11], v[12];
      model.inertias[joint] += Inertia(v[0], v.segment(1, 3), about);
    }
    model.gravity.linear() = numbers(in, 3);
    in >> count;
    for (int k = 0; k < count; k++) {
      const FrameIndex a = frame(in, true);
      points.push_back({a, frame(in, true)});
    }
    in >> count;
    for (int k = 0; k < count; k++) {
      Angle made;
      made.a = frame(in, false);
      made.x = numbers(in, 3);
      made.b = frame(in, false);
      made.y = numbers(in, 3);
      in >> made.cosine;
      angles.push_back(made);
    }
    in >> count;
    actuated.resize(std::size_t(count));
    for (int & k : actuated) in >> k;
    q = numbers(in, model.nv);
    for (int k = 0; k < model.nv; k++)
      if (std::find(actuated.begin(), actuated.end(), k) == actuated.end()) passive.push_back(k);
    const int rows = 3 * int(points.size()) + int(angles.size()), n = int(passive.size());
    data = Data(model);
    v = a = VectorXd::Zero(model.nv);
    all.resize(rows, model.nv);
    error.resize(rows);
    drift.resize(rows);
    left.resize(6, model.nv);
    right.resize(6, model.nv);
    for (const auto & p : points) {
      const Frame & one = model.frames[p.a], & other = model.frames[p.b];
      constraints.emplace_back(
        CONTACT_3D, model, one.parentJoint, one.placement, other.parentJoint, other.placement, LOCAL);
    }
    for (const auto & c : constraints) held.emplace_back(c);
    initConstraintDynamics(model, data, constraints, held);
    // Of dependent rows those that a pivoted factorisation chooses at home are left out.
    place();
    jacobian();
    MatrixXd columns(rows, n);
    for (int k = 0; k < n; k++) columns.col(k) = all.col(passive[std::size_t(k)]);
    Eigen::ColPivHouseholderQR<MatrixXd> qr(columns.transpose());
    for (int k = 0; k < n; k++) kept.push_back(int(qr.colsPermutation().indices()[k]));
    jp.resize(n, n);
    ja.resize(n, count);
    lu = Eigen::PartialPivLU<MatrixXd>(n);
  }

  void place()
  {
    computeJointJacobians(model, data, q);
    updateFramePlacements(model, data);
  }

  Vector3d axis(FrameIndex f, const Vector3d & x) const { return data.oMf[f].rotation() * x; }

  void jacobian()
  {
    int r = 0;
    auto both = [&](FrameIndex a, FrameIndex b) {
      left.setZero();
      right.setZero();
      getFrameJacobian(model, data, a, LOCAL_WORLD_ALIGNED, left);
      getFrameJacobian(model, data, b, LOCAL_WORLD_ALIGNED, right);
    };
    for (const auto & p : points) {
      both(p.a, p.b);
      all.middleRows(r, 3) = left.topRows(3) - right.topRows(3);
      error.segment(r, 3) = data.oMf[p.a].translation() - data.oMf[p.b].translation();
      r += 3;
    }
    for (const auto & p : angles) {
      both(p.a, p.b);
      const Vector3d x = axis(p.a, p.x), y = axis(p.b, p.y);
      all.row(r) = x.cross(y).transpose() * (left.bottomRows(3) - right.bottomRows(3));
      error[r++] = x.dot(y) - p.cosine;
    }
    for (std::size_t i = 0; i < kept.size(); i++) {
      for (std::size_t k = 0; k < passive.size(); k++)
        jp(long(i), long(k)) = all(kept[i], passive[k]);
      for (std::size_t k = 0; k < actuated.size(); k++)
        ja(long(i), long(k)) = all(kept[i], actuated[k]);
    }
  }

  VectorXd chosen(const VectorXd & row) const
  {
    VectorXd result(long(kept.size()));
    for (std::size_t i = 0; i < kept.size(); i++) result[long(i)] = row[kept[i]];
    return result;
  }

  void spread(VectorXd & whole, const VectorXd & driven, const VectorXd & free)
  {
    for (std::size_t k = 0; k < actuated.size(); k++) whole[actuated[k]] = driven[long(k)];
    for (std::size_t k = 0; k < passive.size(); k++) whole[passive[k]] = free[long(k)];
  }

  void close(const VectorXd & driven)
  {
    for (std::size_t k = 0; k < actuated.size(); k++) q[actuated[k]] = driven[long(k)];
    for (int turn = 0; turn < 20; turn++) {
      place();
      jacobian();
      lu.compute(jp);
      const VectorXd step = lu.solve(chosen(error));
      for (std::size_t k = 0; k < passive.size(); k++) q[passive[k]] -= step[long(k)];
      if (step.cwiseAbs().maxCoeff() < 1e-9) break;
    }
    place();
    jacobian();
    lu.compute(jp);
  }

  void rates(const VectorXd & driven) { spread(v, driven, lu.solve(-ja * driven)); }

  VectorXd torques(const VectorXd & at, const VectorXd & rate, const VectorXd & second)
  {
    close(at);
    rates(rate);
    a.setZero();
    forwardKinematics(model, data, q, v, a);
    updateFramePlacements(model, data);
    int r = 0;
    auto moved = [&](FrameIndex f) -> Vector3d {
      return getFrameClassicalAcceleration(model, data, f, LOCAL_WORLD_ALIGNED).linear();
    };
    auto turned = [&](FrameIndex f) -> Vector3d {
      return getFrameVelocity(model, data, f, LOCAL_WORLD_ALIGNED).angular();
    };
    auto spun = [&](FrameIndex f) -> Vector3d {
      return getFrameAcceleration(model, data, f, LOCAL_WORLD_ALIGNED).angular();
    };
    for (const auto & p : points) {
      drift.segment(r, 3) = moved(p.a) - moved(p.b);
      r += 3;
    }
    for (const auto & p : angles) {
      const Vector3d x = axis(p.a, p.x), y = axis(p.b, p.y), wx = turned(p.a), wy = turned(p.b);
      drift[r++] = (spun(p.a) - spun(p.b)).dot(x.cross(y))
        + (wx - wy).dot(wx.cross(x).cross(y) + x.cross(wy.cross(y)));
    }
    spread(a, second, lu.solve(-ja * second - chosen(drift)));
    rnea(model, data, q, v, a);
    VectorXd free(long(passive.size())), driven(long(actuated.size()));
    for (std::size_t k = 0; k < passive.size(); k++) free[long(k)] = data.tau[passive[k]];
    for (std::size_t k = 0; k < actuated.size(); k++) driven[long(k)] = data.tau[actuated[k]];
    const VectorXd forces = lu.transpose().solve(free);
    return driven - ja.transpose() * forces;
  }

  // Of efforts without those of rotors, as this tree has no armature.
  VectorXd accelerations(const VectorXd & at, const VectorXd & rate, const VectorXd & efforts)
  {
    close(at);
    rates(rate);
    a.setZero();
    for (std::size_t k = 0; k < actuated.size(); k++) a[actuated[k]] = efforts[long(k)];
    a = constraintDynamics(model, data, q, v, a, constraints, held, settings);
    VectorXd driven(long(actuated.size()));
    for (std::size_t k = 0; k < actuated.size(); k++) driven[long(k)] = a[actuated[k]];
    return driven;
  }
};

// Four inputs and an output: torques and accelerations of the exported C.
using Exported = int (*)(const double *, const double *, const double *, const double *, double *);

// Accelerations are timed where all loops close in points; elsewhere 0 is printed.
// Words: the machine's numbers, the shared library of its exported C, the prefix of its names, and
// how many rounds are timed.
int main(int, char ** words)
{
  std::ifstream in(words[1]);
  void * library = dlopen(words[2], RTLD_NOW);
  const std::string prefix = words[3];
  const int rounds = std::stoi(words[4]);
  const auto c_torques = Exported(dlsym(library, (prefix + "_torques").c_str()));
  const auto c_accelerations = Exported(dlsym(library, (prefix + "_accelerations").c_str()));
  Loops loops(in);
  const int n = int(loops.actuated.size());
  int count;
  in >> count;
  const double wrench[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
  const bool whole = loops.angles.empty();
  double out[6], sum = 0.0, miss = 0.0, other = 0.0, size = 0.0, change = 0.0, most = 0.0;
  std::vector<VectorXd> q, qd, qdd, tau, load;
  for (int i = 0; i < count; i++) {
    q.push_back(numbers(in, n));
    qd.push_back(numbers(in, n));
    qdd.push_back(numbers(in, n));
    tau.push_back(numbers(in, n));
    load.push_back(numbers(in, n));
  }
  for (int i = 0; i < count; i++) {
    const auto k = std::size_t(i);
    const double here = (loops.torques(q[k], qd[k], qdd[k]) - tau[k]).cwiseAbs().maxCoeff();
    if (!(here <= miss)) miss = here;
    const bool failed = c_torques(q[k].data(), qd[k].data(), qdd[k].data(), wrench, out) != 0;
    const double there = (Eigen::Map<VectorXd>(out, n) - load[k]).cwiseAbs().maxCoeff();
    if (failed || !(there <= other)) other = failed ? INFINITY : there;
    size = std::max(size, tau[k].cwiseAbs().maxCoeff());
    most = std::max(most, qdd[k].cwiseAbs().maxCoeff());
    if (!whole) continue;
    const double apart = (loops.accelerations(q[k], qd[k], tau[k]) - qdd[k]).cwiseAbs().maxCoeff();
    if (!(apart <= change)) change = apart;
  }
  std::vector<std::vector<double>> times(5);
  for (int round = 0; round < rounds; round++) {
    double begun = now();
    for (std::size_t k = 0; k < q.size(); k++) sum += loops.torques(q[k], qd[k], qdd[k])[0];
    times[0].push_back(now() - begun);
    begun = now();
    for (std::size_t k = 0; k < q.size(); k++)
      sum += rnea(loops.model, loops.data, loops.q, loops.v, loops.a)[0];
    times[1].push_back(now() - begun);
    begun = now();
    for (std::size_t k = 0; k < q.size(); k++) {
      sum += c_torques(q[k].data(), qd[k].data(), qdd[k].data(), wrench, out);
      sum += out[0];
    }
    times[2].push_back(now() - begun);
    begun = now();
    for (std::size_t k = 0; k < q.size(); k++) {
      sum += c_accelerations(q[k].data(), qd[k].data(), load[k].data(), wrench, out);
      sum += out[0];
    }
    times[3].push_back(now() - begun);
    begun = now();
    for (std::size_t k = 0; whole && k < q.size(); k++)
      sum += loops.accelerations(q[k], qd[k], tau[k])[0];
    times[4].push_back(now() - begun);
  }
  std::cout << loops.model.nv << " " << miss / size << " " << other / size << " " << change / most;
  for (auto & row : times) {
    std::sort(row.begin(), row.end());
    std::cout << " " << (row.empty() ? 0.0 : 1e9 * row[row.size() / 2] / double(count));
  }
  std::cout << " " << sum << std::endl;
  return 0;
}
